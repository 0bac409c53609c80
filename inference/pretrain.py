"""Maximum-likelihood pretraining of a guide on derivations of the prior (Meta-Sim2, section 3.3: "essential")."""

from collections.abc import Callable

import torch

from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.policy import Policy

from .guides.base import Guide
from .training import check_finite


def pretrain(
    guide: Guide,
    prior: Policy,
    num_derivations: int = 5000,
    epochs: int = 10,
    batch_size: int = 100,
    learning_rate: float = 1e-3,
    progress: Callable[[int, float], None] | None = None,
) -> float:
    """Fit ``guide`` to derivations drawn from ``prior``.

    Args:
        guide: a module with ``grammar``, ``max_steps`` and ``log_prob``.
        prior: the structure prior.
        num_derivations, epochs, batch_size, learning_rate: the paper's are the defaults.
        progress: called after each epoch with its number, from 0, and the mean negative log-likelihood.

    Returns:
        The last epoch's mean negative log-likelihood, nats a scene.

    Raises:
        ProbsceneError: it, or a parameter, is no longer finite.
    """
    data, _ = derive_complete(guide.grammar, prior, num_derivations, guide.max_steps)
    optimiser = torch.optim.Adam(guide.parameters(), lr=learning_rate)
    loss = float("nan")
    for epoch in range(epochs):
        total = 0.0
        for rows in torch.randperm(num_derivations).split(batch_size):
            nll = -guide.log_prob(_cut(data[rows])).mean()
            optimiser.zero_grad()
            nll.backward()
            optimiser.step()
            total += nll.item() * len(rows)
        loss = total / num_derivations
        remedy = f"begin again with a lower rate, such as pretrain_rate={learning_rate / 10:g}"
        check_finite(loss, guide.parameters(), "the guide in pretraining", f"in epoch {epoch + 1}", remedy)
        if progress is not None:
            progress(epoch, loss)
    optimiser.zero_grad()  # SVI adds to the gradients that it finds
    return loss


def _cut(derivation: Derivation) -> Derivation:
    """Without the steps at which every scene of the batch is finished."""
    steps = int(derivation.lengths.max())
    return Derivation(
        derivation.rules[:, :steps],
        derivation.complete,
        derivation.kind,
        derivation.parent,
        type(derivation.frontier)(*(x[:, :steps] for x in derivation.frontier)),
    )
