"""Several models as one: a scenario is drawn, then a scene of that scenario's own model (Meta-Sim2, supplement).

The joint grammar has a first production for every scenario, ``Scenario -> Scene-city | Scene-rural``, and below it each
scenario's own productions, their nonterminals marked with its name. Objects of one name are one kind. The program runs
every scenario's own program on its own part of the derivations, its sites named ``city/car.x``, and joins what they
draw; a scene of another scenario counts nowhere in it. Whatever works on a model works on several, then: previews,
features, datasets, provenance, reports. Axis letters: N scenes, T steps, K rules, S scenarios.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import cast

import pyro
import torch
from pyro import poutine
from pyro.poutine.messenger import Messenger
from torch import BoolTensor, Tensor

from .derivation import Derivation, Frontier, expand
from .derive import ConditionDerivation, derive
from .enumeration import shortest_lengths
from .errors import ModelError
from .grammar import Grammar, Node, Rule, is_nonterminal
from .joining import join_drawings
from .model import SceneModel
from .policy import Policy
from .request import Renderable
from .sampling import check_nodes
from .structure import StructurePrior

START = "Scenario"


class JointGrammar(Grammar):
    """One grammar out of several, and the way between a joint derivation and its part.

    Args:
        parts: the scenarios' own grammars, by name.

    Attributes:
        parts: as given.
        first_rule: the joint number of each part's first rule, a list of S; the part's rules follow in its own order.
        first_symbol: likewise of its nonterminals.
    """

    def __init__(self, parts: Mapping[str, Grammar]):
        self.parts = dict(parts)
        rules = [Rule(START, f"{part.nonterminals[0]}-{name}") for name, part in self.parts.items()]
        for name, part in self.parts.items():
            rules += [
                Rule(f"{rule.lhs}-{name}", *(_marked(symbol, name) for symbol in rule.rhs)) for rule in part.rules
            ]
        super().__init__(rules)
        rules_before, symbols_before = len(self.parts), 1
        self.first_rule, self.first_symbol = [], []
        for part in self.parts.values():
            self.first_rule.append(rules_before)
            self.first_symbol.append(symbols_before)
            rules_before, symbols_before = rules_before + len(part.rules), symbols_before + len(part.nonterminals)

    def scenario(self, derivation: Derivation) -> Tensor:
        """``(N,)`` int64, which scenario each scene is of; 0 where nothing is derived yet."""
        return derivation.rules[:, 0].clamp(min=0)

    def own(self, derivation: Derivation, number: int) -> Derivation:
        """Derivations that are all of scenario ``number``, as ones of its own grammar."""
        own = list(self.parts.values())[number]
        rules = derivation.rules[:, 1:]
        rules = (rules - self.first_rule[number]).masked_fill(rules < 0, -1)
        frontier, _ = self.part_frontier(Frontier(*(x[:, 1:] for x in derivation.frontier)), number)
        kinds = torch.tensor([own.kinds.index(kind) if kind in own.kinds else -1 for kind in self.kinds] + [-1])
        return Derivation(rules, derivation.complete, kinds[derivation.kind], derivation.parent, frontier)

    def sites(self, derivation: Derivation, number: int) -> dict[str, Tensor]:
        """The values ``(N, 1)`` of the sites ``rule_t`` of scenario ``number``'s own program: of its own scenes, and of
        a shortest derivation in all others."""
        own, rules = self.scenario(derivation) == number, derivation.rules[:, 1:]
        shortest = self._shortest[number].rules[0]
        padded = torch.zeros(len(rules), max(rules.shape[1], len(shortest)), dtype=torch.int64)
        padded[:, : rules.shape[1]] = (rules - self.first_rule[number]).masked_fill(rules < 0, 0)
        padded[~own] = 0
        padded[~own, : len(shortest)] = shortest
        return {f"rule_{t}": padded[:, t : t + 1] for t in range(padded.shape[1])}

    def part(self, derivation: Derivation, number: int) -> Derivation:
        """What scenario ``number``'s own program derives of N joint scenes: its own ones, and a shortest derivation in
        all others. See ``sites``."""
        own = self.scenario(derivation) == number
        grammar, short = list(self.parts.values())[number], self._shortest[number]
        parts = [(own.nonzero().flatten(), self.own(derivation[own], number))]
        parts.append(((~own).nonzero().flatten(), short[torch.zeros(int((~own).sum()), dtype=torch.int64)]))
        return Derivation.merged(grammar, [(rows, part) for rows, part in parts if len(rows)])

    @cached_property
    def _shortest(self) -> list[Derivation]:
        return [_shortest(grammar) for grammar in self.parts.values()]

    def part_frontier(self, frontier: Frontier, number: int) -> tuple[Frontier, Tensor]:
        """What scenario ``number``'s own policy sees of a joint frontier, and in which scenes ``(N,)``; elsewhere, and
        before the scenario is drawn, its derivation seems finished."""
        grammar = list(self.parts.values())[number]
        symbol = frontier.symbol - self.first_symbol[number]
        own = (symbol >= 0) & (symbol < len(grammar.nonterminals))
        return frontier._replace(symbol=symbol.where(own, len(grammar.nonterminals))), own


class ScopeMessenger(Messenger):
    """Names sites ``name/site``, so that several programs can run in one."""

    def __init__(self, name: str):
        super().__init__()
        self.name = name

    def _pyro_sample(self, msg):
        msg["name"] = f"{self.name}/{msg['name']}"


class Mixture(Policy):
    """A scenario by its weight, then its own policy.

    Args:
        grammar: the joint grammar.
        policies: one of each scenario's own grammar, in the joint order.
        weights: of the scenarios; equal if None.
    """

    grammar: JointGrammar

    def __init__(self, grammar: JointGrammar, policies: Sequence[Policy], weights: list[float] | None = None):
        self.grammar, self.policies = grammar, policies
        share = torch.tensor([1.0] * len(policies) if weights is None else weights)
        self.log_weights = (share / share.sum()).log()

    def start(self, num_scenes: int) -> list:
        """The memories of all policies."""
        memory = []
        for name, policy in zip(self.grammar.parts, self.policies, strict=True):
            with ScopeMessenger(name):
                memory.append(policy.start(num_scenes))
        return memory

    def step(self, memory: list, frontier: Frontier, previous_rule: Tensor) -> tuple[Tensor, list]:
        """Logits ``(N, K)``: all policies take the step, and each scene's own counts. They begin when the scenario is
        drawn, which is every scene's first step."""
        logits = torch.zeros(len(frontier.symbol), len(self.grammar.rules))
        logits[:, : len(self.policies)] = self.log_weights
        if (frontier.symbol == 0).any():
            return logits, memory
        following = []
        for number, policy in enumerate(self.policies):
            first, size = self.grammar.first_rule[number], len(policy.grammar.rules)
            own_frontier, own = self.grammar.part_frontier(frontier, number)
            previous = (previous_rule - first).where(own & (previous_rule >= first), -1)
            step, after = policy.step(memory[number], own_frontier, previous)
            logits[:, first : first + size] = step
            following.append(after)
        return logits, following

    def log_prob(self, derivation: Derivation) -> Tensor:
        """``log q(T)``, ``(N,)``: the scenario's log weight and its own policy's log-probability."""
        scenario = self.grammar.scenario(derivation)
        total = self.log_weights[scenario]
        for number, policy in enumerate(self.policies):
            rows = (scenario == number).nonzero().flatten()
            if len(rows):
                own = policy.log_prob(self.grammar.own(derivation[rows], number))
                total = total.index_add(0, rows, own.to(total.dtype))
        return total


def join(name: str, models: Mapping[str, SceneModel], weights: list[float] | None = None) -> SceneModel:
    """One model that draws a scenario, equally often each unless weighted, and then a scene of it.

    Args:
        name: of the joint model.
        models: by scenario.

    Raises:
        ModelError: no models, or models that differ in canvas, channels, renderer or generator.
    """
    if not models:
        raise ModelError("expected at least one scenario, got none.")
    each = list(models.values())
    for what in ("canvas", "channels", "renderer", "generator"):
        found = {key: getattr(model, what) for key, model in models.items()}
        if len(set(found.values())) > 1:
            raise ModelError(f"expected scenarios of one {what}, got {found}.")
    grammar = JointGrammar({key: model.grammar for key, model in models.items()})
    groups = {model.groups for model in each}
    variables = {model.assets_variable for model in each}
    targets = [model.target for model in each]
    pretraining = None
    if any(model.pretraining is not None for model in each):
        pretraining = mixture(grammar, [model.pretraining_policy for model in each], weights)

    def target(seed: int) -> SceneModel:
        """The scenarios' own targets, joined."""
        return join(
            f"{name}_target", {key: model.target(seed) for key, model in models.items() if model.target}, weights
        )

    def with_assets(folder: str) -> SceneModel:
        """All scenarios drawn with one folder."""
        return join(
            name, {key: model.with_assets(folder) for key, model in models.items() if model.with_assets}, weights
        )

    return SceneModel(
        name,
        grammar,
        mixture(grammar, [model.prior for model in each], weights),
        partial(_program, grammar, dict(models)),
        each[0].canvas,
        1 + max(model.max_steps for model in each),
        tuple(dict.fromkeys(c for model in each for c in model.classes)),
        channels=each[0].channels,
        assets="; ".join(dict.fromkeys(model.assets for model in each if model.assets)),
        with_assets=with_assets if all(model.with_assets for model in each) else None,
        groups=groups.pop() if len(groups) == 1 else None,
        stuff=tuple(dict.fromkeys(c for model in each for c in model.stuff)),
        pretraining=pretraining,
        target=target if all(targets) else None,
        scenarios=tuple(models.items()),
        renderer=each[0].renderer,
        generator=each[0].generator,
        assets_variable=variables.pop() if len(variables) == 1 else "",
    )


def mixture(grammar: JointGrammar, policies: list[Policy], weights: list[float] | None = None) -> Policy:
    """``Mixture``; of tables it is one table, about which more can be proved."""
    tables = [policy for policy in policies if type(policy) is StructurePrior]
    if len(tables) == len(policies):
        given = [1.0] * len(policies) if weights is None else weights
        return StructurePrior.joined(grammar, tables, grammar.first_symbol, grammar.first_rule, given)
    return Mixture(grammar, policies, weights)


def _program(grammar: JointGrammar, models: dict[str, SceneModel], num_scenes: int, structure: Policy) -> Renderable:
    max_steps = 1 + max(model.max_steps for model in models.values())
    with pyro.plate("scenes", num_scenes, dim=-2):
        derivation = derive(grammar, structure, num_scenes, max_steps)
    scenario = grammar.scenario(derivation)
    drawn = []
    for number, (name, model) in enumerate(models.items()):
        own = scenario == number
        sites = grammar.sites(derivation, number)
        part = grammar.part(derivation, number)
        known = ConditionDerivation(
            model.grammar, part, any_length=True
        )  # the joint model's T_max may be larger than the part's own
        counted = cast(BoolTensor, own.unsqueeze(1))
        with ScopeMessenger(name), poutine.mask(mask=counted), poutine.block(hide=list(sites)), known:
            drawing = poutine.condition(model, data=sites)(num_scenes)
        if isinstance(drawing, Renderable):
            check_nodes(model.name, drawing, part)
        drawn.append((own, drawing))
    return join_drawings(derivation.kind, grammar.kinds, drawn)


def _marked(symbol: str | Node, name: str) -> str | Node:
    """A symbol of a part in the joint grammar: nonterminals carry the part's name."""
    if isinstance(symbol, Node):
        return Node(symbol.name, tuple(_marked(child, name) for child in symbol.children))
    return f"{symbol}-{name}" if is_nonterminal(symbol) else symbol


def _shortest(grammar: Grammar) -> Derivation:
    """One derivation with the fewest rules."""
    lengths = torch.tensor(shortest_lengths(grammar), dtype=torch.float64)
    needed = 1 + (lengths[grammar.children.clamp(min=0)] * (grammar.children >= 0)).sum(1)
    best = needed.where(grammar.legal[:-1], torch.inf).argmin(1).numpy()
    steps = int(lengths[0])
    return expand(grammar, lambda t, frontier, previous: best[frontier[0]], 1, steps)
