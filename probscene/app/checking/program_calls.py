"""What a program calls while it runs: the ``max_steps`` that it derives with, and parents that it reads and that do not
exist.
"""

import functools
from dataclasses import replace

from pyro.poutine.messenger import Messenger

from probscene.grammar import Grammar, Node, is_nonterminal
from probscene.model import SceneModel
from probscene.relations import relations
from probscene.sampling import Scenes


class CallRecorder(Messenger):
    """An effect handler that records what a program calls.

    Attributes:
        max_steps: those that it derives the grammar with.
        reads_parents: whether it reads values of parents.
        has_parents: whether any node had a parent then.
    """

    def __init__(self, grammar: Grammar):
        super().__init__()
        self.grammar, self.reads_parents, self.has_parents = grammar, False, False
        self.max_steps: set[int] = set()

    def _pyro_derive(self, msg) -> None:
        grammar, _, _, max_steps = msg["args"]
        if grammar.rules == self.grammar.rules:
            self.max_steps.add(max_steps)

    def _pyro_of_parent(self, msg) -> None:
        _, parent, _ = msg["args"]
        self.reads_parents = True
        self.has_parents |= bool((parent >= 0).any())


def recorded(model: SceneModel, recorder: CallRecorder) -> SceneModel:
    """The same model; what its program calls is recorded."""

    @functools.wraps(model.program)
    def program(num_scenes, structure):
        with recorder:
            return model.program(num_scenes, structure)

    return replace(model, program=program)


def short_max_steps(model: SceneModel, recorder: CallRecorder) -> list[str]:
    """Faults of a program that derives with a smaller ``max_steps`` than its model's."""
    return [
        f"The program derives with max_steps = {other} and the model says max_steps = {model.max_steps}: longer scenes "
        "would be cut short; give derive(...) the model's, or say it once with scene_model."
        for other in sorted(recorder.max_steps)
        if other < model.max_steps
    ]


def long_max_steps(model: SceneModel, recorder: CallRecorder) -> list[str]:
    """Warnings of a program that derives with a larger ``max_steps`` than its model's."""
    return [
        f"The program derives with max_steps = {other} and the model says max_steps = {model.max_steps}, which counts; "
        "give derive(...) the model's, or say it once with scene_model."
        for other in sorted(recorder.max_steps)
        if other > model.max_steps
    ]


def missing_parents(model: SceneModel, recorder: CallRecorder, scenes: Scenes) -> list[str]:
    """Warnings of parents' values that a program reads and its grammar does not give; ``scenes`` are some of its."""
    grammar = model.grammar
    parents = {parent for parent, _ in relations(grammar)}
    for rule in grammar.rules:
        for i, (symbol, after) in enumerate(zip(rule.rhs, rule.rhs[1:], strict=False)):
            if not isinstance(symbol, str) or is_nonterminal(symbol) or symbol in parents:
                continue
            if not isinstance(after, str) or not is_nonterminal(after) or after == rule.lhs:
                continue
            is_list = bool(grammar.recursive[grammar.nonterminals.index(after)])
            grouped = model.groups is not None and model.groups.kind == symbol
            if grouped or (
                recorder.reads_parents
                and (not recorder.has_parents or (is_list and _has_sites(grammar, scenes, symbol)))
            ):
                right = " ".join(map(str, (*rule.rhs[:i], Node(symbol, (after,)), *rule.rhs[i + 2 :])))
                who = "groups are counted by it" if grouped else "scene.of_parent finds no parent there"
                return [
                    f"In '{rule}' what {after} derives stands beside {symbol!r} and not below it, and {who}; if it "
                    f"belongs to {symbol!r}, write '{rule.lhs} -> {right}'."
                ]
    if recorder.reads_parents and not recorder.has_parents:
        return [
            "The program reads values of parents (scene.of_parent), and no object has a parent; make children with "
            "brackets, such as 'Plate -> plate(Mugs)'."
        ]
    return []


def _has_sites(grammar: Grammar, scenes: Scenes, kind: str) -> bool:
    """Whether nodes of a kind have parameters of their own."""
    here = scenes.drawing.kind == grammar.kind(kind)
    return any(mask.shape == here.shape and bool((mask & here).any()) for mask in scenes.site_mask.values())
