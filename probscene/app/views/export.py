"""``probscene view``: scenes that one can turn, as a Rerun recording or as glTF."""

from pathlib import Path

from probscene.errors import DataError, ProbsceneError
from probscene.sampling import sample
from probscene.world import World

from ..chunks import chunk_randomness
from ..loading import renderer_for
from .preview import opened

SUFFIXES = (".rrd", ".glb")


def view(model_or_run: str, out: Path, num: int = 1, seed: int = 0, assets: Path | None = None) -> None:
    """Write scenes of a model's prior, or of a run's learnt structures, as ``out`` says by its suffix.

    Args:
        assets: see ``preview.opened``.

    Raises:
        ProbsceneError: a number that is not positive, several scenes in a .glb; see ``load_model`` and ``RunFolder``.
        DataError: another suffix, or a .glb of a model in 2D.
        MachineError: the file cannot be written, or Rerun is not installed.
    """
    out = Path(out)
    if out.suffix not in SUFFIXES or out.is_dir():
        raise DataError(f"expected a file with the suffix {' or '.join(SUFFIXES)}, got {out}; name one.")
    if num < 1 or (num > 1 and out.suffix == ".glb"):
        raise ProbsceneError(f"expected a positive number of scenes, one in a .glb, got {num}.")
    model, policy = opened(model_or_run, assets)
    with chunk_randomness(seed, 0):  # the first scenes of "preview" with this seed
        scenes = sample(model, policy, num)
    if out.suffix == ".rrd":
        from .recording import write_recording

        write_recording(out, model, scenes.derivation, scenes.drawing, renderer_for(model)(scenes.drawing))
    elif isinstance(scenes.drawing, World):
        from .gltf import write_gltf

        write_gltf(out, scenes.drawing, 0, model.canvas)
    else:
        raise DataError(f"expected a model in 3D for {out.name}, got {model.name!r}, which draws sprites; write .rrd.")
