"""What to write in a model so that a list has more room."""

from functools import lru_cache

from probscene.branching import Branching
from probscene.enumeration import shortest_lengths
from probscene.grammar import Grammar
from probscene.lists import ListBounds
from probscene.model import SceneModel
from probscene.scenarios import JointGrammar
from probscene.structure import StructurePrior

KEPT = 0.999 - 1e-6  # share of derivations that the longest of a prior's covers
FOLLOWED = 1000  # rules


def called(grammar: Grammar, symbol: int) -> str:
    """A nonterminal as its model writes it; with its scenario, where there are several."""
    name = grammar.nonterminals[symbol]
    if isinstance(grammar, JointGrammar) and symbol:
        number = sum(first <= symbol for first in grammar.first_symbol) - 1
        scenario = list(grammar.parts)[number]
        return f"{name.removesuffix(f'-{scenario}')} of scenario {scenario!r}"
    return name


def more_room(model: SceneModel, bounds: ListBounds, longest: int, shortest: int | None = None) -> str:
    """The change of the prior's line for a list up to ``longest``, and of T_max where that is too short for it.

    Args:
        shortest: where it is to be less than the prior's.
    """
    least = bounds.shortest if shortest is None else min(shortest, bounds.shortest)
    name, _, scenario = called(model.grammar, bounds.symbol).partition(" of ")
    zeros = f"*[0] * {least}, " if least else ""
    line = f"counts({zeros}*[1] * {longest - least + 1})"
    where = f" in {scenario}" if scenario else ""
    if bounds.parent_list_index is not None:
        rank = bounds.parent_list_index + 1
        said = f"{name}=ranked(...){where} with counts(...) up to {longest} at rank {rank}, such as {line}"
    else:
        lower = f" from {least}" if least < bounds.shortest else ""
        said = f"{name}=counts(...){where}{lower} up to {longest}, such as {name}={line}"
    steps = steps_for(model, bounds, longest)
    return said + (f", and max_steps={steps}" if steps > model.max_steps else "")


def steps_for(model: SceneModel, bounds: ListBounds, longest: int) -> int:
    """The T_max that leaves a longer list as much room as the prior's longest has now."""
    grammar, prior = model.grammar, model.prior
    now = _longest_kept(grammar, prior, model.max_steps) if isinstance(prior, StructurePrior) else 0
    fewest = shortest_lengths(grammar)
    each = [
        1 + sum(fewest[v] for v in row if v >= 0 and v != bounds.symbol)
        for row in grammar.children[grammar.legal[bounds.symbol]].tolist()
        if bounds.symbol in row
    ]
    return now + max(each) * max(0, longest - bounds.prior)


@lru_cache(maxsize=4)
def _longest_kept(grammar: Grammar, prior: StructurePrior, max_steps: int) -> int:
    """The fewest rules that nearly all of a prior's derivations keep to."""
    process = Branching(grammar, prior.table)
    known = process.lengths(max_steps, KEPT, FOLLOWED if process.spectral_radius < 1 else 0)
    enough = (known.cumsum() >= KEPT).nonzero()[0]
    return int(enough[0]) if len(enough) else len(known) - 1
