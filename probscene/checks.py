"""What a person should know before fitting: does every derivation end, how long is it, does T_max cover it.

``check(model)`` gives a ``Report``; ``str(report)`` says it in words, ``faults`` are to be fixed first.
"""

from dataclasses import dataclass, replace

import numpy as np
import pyro
import torch

from .branching import CRITICAL, Branching
from .derive import derive
from .enumeration import shortest_lengths
from .errors import GrammarError
from .grammar import Grammar
from .model import SceneModel
from .policy import Policy
from .structure import StructurePrior

QUANTILES = (0.5, 0.9, 0.99, 0.999)
LONGEST_LOOK = 1000  # rules; lengths beyond are not followed for a quantile
ROUNDING = 1e-6  # a quantile of exactly 0.9 is one of 0.9 in the table's float32 too
REDRAWN_WARNING, REDRAWN_FAULT = 1e-3, 0.9  # shares of derivations longer than max_steps


@dataclass(frozen=True)
class Report:
    """A grammar under a prior. Lengths count rules.

    Attributes:
        grammar: the grammar.
        max_steps: T_max.
        faults: what must be fixed, each with what to do.
        warnings: what should be known.
        spectral_radius: of the mean-offspring matrix; every derivation ends iff it is below 1. NaN if only sampled.
        expected_length: mean number of rules; infinite if a derivation need not end.
        expected_nodes: mean number of objects of each kind.
        lengths: ``lengths[n]`` is the probability of n rules, at least up to ``max_steps``.
        longest: length of the longest derivation; infinite if there is none. NaN if only sampled.
        unused: rules that the prior never chooses; empty if only sampled.
        samples: 0 where the figures are exact, else from how many derivations they are taken.
    """

    grammar: Grammar
    max_steps: int
    faults: tuple[str, ...]
    warnings: tuple[str, ...]
    spectral_radius: float
    expected_length: float
    expected_nodes: dict[str, float]
    lengths: tuple[float, ...]
    longest: float
    unused: tuple[int, ...]
    samples: int = 0

    @property
    def longer(self) -> float:
        """Probability of more than ``max_steps`` rules."""
        return _none_if_rounding(1.0 - sum(self.lengths[: self.max_steps + 1]))

    def quantile(self, share: float) -> int | None:
        """The fewest rules that this share of derivations keeps to; None if beyond the lengths that were computed."""
        enough = np.flatnonzero(np.cumsum(self.lengths) >= share - ROUNDING)
        return int(enough[0]) if len(enough) else None

    def __str__(self) -> str:
        g = self.grammar
        lines = [f"{len(g.nonterminals)} nonterminals, {len(g.rules)} rules, {len(g.kinds)} kinds of object."]
        if self.samples:
            lines.append(f"Figures are taken from {self.samples} derivations.")
        elif self.spectral_radius < CRITICAL:
            bounded = np.isfinite(self.longest)
            end = f"the longest takes {self.longest:.0f} rules" if bounded else "there is no longest one"
            lines.append(f"Every derivation ends (spectral radius {self.spectral_radius:.3g}); {end}.")
        else:
            lines.append(f"A derivation need not end (spectral radius {self.spectral_radius:.3g}).")
        if np.isfinite(self.expected_length):
            kept = [f"{100 * share:g} % within {_or_more(self, share)}" for share in QUANTILES]
            lines.append(f"A derivation takes {self.expected_length:.3g} rules on average; {', '.join(kept)}.")
            nodes = [f"{name} {mean:.3g}" for name, mean in self.expected_nodes.items()]
            lines.append(f"Objects in a scene, on average: {', '.join(nodes)}.")
        longer = f"{_percent(self.longer)} of derivations are longer" if self.longer else "covers every derivation"
        lines.append(f"max_steps = {self.max_steps}: {longer}.")
        lines += [f"Fault: {text}" for text in self.faults] + [f"Warning: {text}" for text in self.warnings]
        if not self.faults and not self.warnings:
            lines.append("Nothing to fix.")
        return "\n".join(lines)


def check(model: SceneModel) -> Report:
    """A model's grammar, prior and ``max_steps``, and whether its classes occur."""
    report = check_grammar(model.grammar, model.prior, model.max_steps)
    absent = [name for name in model.classes if not report.expected_nodes[name] > 0]
    if not absent:
        return report
    names = ", ".join(absent)
    text = f"Classes of model {model.name!r} that no scene of the prior holds: {names}; give their rules a weight."
    return replace(report, warnings=(*report.warnings, text))


def check_grammar(grammar: Grammar, prior: Policy, max_steps: int, samples: int = 1000) -> Report:
    """A grammar under a prior: exact for a ``StructurePrior``, from ``samples`` derivations for any other policy.

    Raises:
        GrammarError: the prior is one over another grammar.
    """
    if prior.grammar.rules != grammar.rules:
        raise GrammarError("expected a prior over this grammar, got one over another; build both from one Grammar.")
    exact = isinstance(prior, StructurePrior)
    report = _exact(grammar, prior, max_steps) if exact else _sampled(grammar, prior, max_steps, samples)
    faults, warnings = list(report.faults), list(report.warnings)
    fewest = shortest_lengths(grammar)[0]
    if max_steps < fewest:
        faults.append(f"max_steps = {max_steps} is too short for any derivation; raise it to at least {fewest}.")
    elif not faults and report.longer > REDRAWN_WARNING:
        most = report.quantile(QUANTILES[-1])
        remedy = f"raise max_steps to {most}" if most and most > max_steps else "raise max_steps or make lists shorter"
        text = f"{_percent(report.longer)} of derivations are longer than max_steps = {max_steps} and are drawn again"
        if report.longer > REDRAWN_FAULT:
            faults.append(f"{text}, too many to go on; {remedy}.")
        else:
            warnings.append(f"{text}, so that large scenes are rarer than the prior says; {remedy}.")
    if report.unused:
        rules = ", ".join(f"'{grammar.rules[k]}'" for k in report.unused)
        warnings.append(
            f"The prior never chooses {rules}, and the guide is pretrained on the prior; "
            "give each a weight above 0, or delete it."
        )
    return replace(report, faults=tuple(faults), warnings=tuple(warnings))


def _exact(grammar: Grammar, prior: StructurePrior, max_steps: int) -> Report:
    process = Branching(grammar, prior.table)
    used = process.expected_rules()
    ends = process.spectral_radius < CRITICAL
    lengths = process.lengths(max_steps, QUANTILES[-1] - ROUNDING, LONGEST_LOOK if ends else 0)
    return Report(
        grammar,
        max_steps,
        tuple(_endless(process, group, radius) for radius, group in process.cycles if radius >= CRITICAL),
        (),
        process.spectral_radius,
        float(used.sum()),
        {name: float(_times(_objects(grammar, j), used)) for j, name in enumerate(grammar.kinds)},
        tuple(lengths.tolist()),
        process.longest(),
        tuple(int(k) for k in np.flatnonzero(used == 0)),
    )


def _sampled(grammar: Grammar, policy: Policy, max_steps: int, samples: int) -> Report:
    with torch.no_grad(), pyro.poutine.block():
        derivation = derive(grammar, policy, samples, max_steps)
    number = derivation.lengths[derivation.complete]
    nodes = derivation.counts(len(grammar.kinds)).double().mean(0).tolist()
    return Report(
        grammar,
        max_steps,
        (),
        (f"The prior is no StructurePrior but a {type(policy).__name__}: nothing proves that its derivations end.",),
        float("nan"),
        float(derivation.lengths.double().mean()),
        dict(zip(grammar.kinds, nodes, strict=True)),
        tuple((torch.bincount(number, minlength=max_steps + 1).double() / samples).tolist()),
        float("nan"),
        (),
        samples,
    )


def _endless(process: Branching, group: list[int], radius: float) -> str:
    """What to do about a set of types that leaves as many of itself behind as it began with."""
    grammar = process.grammar
    inside = np.isin(process.owner, group)
    again = inside & np.isin(process.children, group).any(1)
    symbols = sorted({process.types[i].symbol for i in group})
    names = [grammar.nonterminals[v] for v in symbols]
    going_on, stopping = set(process.rule[again].tolist()), set()
    for name in names:
        stopping |= set(grammar.rules_of(name)) - going_on
    lines = [line for line in str(grammar).splitlines() if line.split(" -> ")[0] in names]
    of = {k: f"'{grammar.rules[k]}'" for k in going_on | stopping}
    remedy = f"lower the weight of {', '.join(of[k] for k in sorted(going_on))}"
    if stopping:
        remedy += f" or raise that of {', '.join(of[k] for k in sorted(stopping))}"
    if len(names) == 1 and all((grammar.children[k] == symbols[0]).sum() == 1 for k in going_on) and stopping:
        remedy += f", or give its lengths with {names[0]}=counts(...)"
    each = f"on average each {names[0]} leads to" if len(names) == 1 else "on average each round leads to"
    what = " and ".join(f"'{line}'" for line in lines)
    return f"{what} need not terminate: {each} {radius:.3g} more, and it must be below 1; {remedy}."


def _objects(grammar: Grammar, kind: int) -> np.ndarray:
    return (grammar.objects == kind).sum(1).numpy()


def _times(number: np.ndarray, used: np.ndarray) -> float:
    return (number[number > 0] * used[number > 0]).sum()  # 0 times infinity is 0 here


def _none_if_rounding(probability: float) -> float:
    return probability if probability > ROUNDING else 0.0


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.4g} %"


def _or_more(report: Report, share: float) -> str:
    most = report.quantile(share)
    return f"more than {len(report.lengths) - 1}" if most is None else str(most)
