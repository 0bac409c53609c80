"""Productions as text and as Python, and every fault that is found when a grammar is built."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.errors import GrammarError
from probscene.grammar import Grammar, Node, Rule, parse

TABLETOP = """
    Scene  -> table(Plates) bg   # comment
    Plates -> Plate Plates | ε
    Plate  -> plate(Mugs spoon)
            | tray
    Mugs   → mug Mugs | eps
"""
TABLETOP_RULES = [
    Rule("Scene", Node("table", ("Plates",)), "bg"),
    Rule("Plates", "Plate", "Plates"),
    Rule("Plates"),
    Rule("Plate", Node("plate", ("Mugs", "spoon"))),
    Rule("Plate", "tray"),
    Rule("Mugs", "mug", "Mugs"),
    Rule("Mugs"),
]


def same(one, other):
    tables = ("legal", "children", "child_owner", "objects", "object_owner", "lhs", "recursive")
    named = ("rules", "nonterminals", "kinds")
    return all(getattr(one, a) == getattr(other, a) for a in named) and all(
        torch.equal(getattr(one, a), getattr(other, a)) for a in tables
    )


def test_python_rules_are_the_text_ones():
    assert same(Grammar(TABLETOP), Grammar(TABLETOP_RULES))


def test_tables_of_a_small_grammar():
    grammar = Grammar(TABLETOP)
    assert grammar.nonterminals == ("Scene", "Plates", "Plate", "Mugs")
    assert grammar.kinds == ("table", "bg", "plate", "spoon", "tray", "mug")
    assert grammar.children.tolist() == [[1, -1], [1, 2], [-1, -1], [3, -1], [-1, -1], [3, -1], [-1, -1]]
    assert grammar.child_owner.tolist() == [[0, -1], [-1, -1], [-1, -1], [0, -1], [-1, -1], [-1, -1], [-1, -1]]
    assert grammar.objects[:4].tolist() == [[0, 1], [-1, -1], [-1, -1], [2, 3]]
    assert grammar.object_owner[3].tolist() == [-1, 0]
    assert grammar.recursive.tolist() == [False, True, False, True, False]
    assert grammar.rules_of("Plate") == [3, 4] and grammar.kind("tray") == 4


@given(st.from_type(Grammar))
def test_text_of_a_grammar_parses_back(grammar):
    assert same(Grammar(str(grammar)), grammar)
    assert same(Grammar(grammar.rules), grammar)


@given(st.from_type(Grammar), st.randoms(use_true_random=False))
def test_the_order_of_lines_of_other_nonterminals_changes_nothing_but_the_order(grammar, random):
    lines = str(grammar).splitlines()
    rest = lines[1:]
    random.shuffle(rest)
    shuffled = Grammar("\n".join([lines[0], *rest]))
    assert set(shuffled.rules) == set(grammar.rules) and shuffled.nonterminals[0] == grammar.nonterminals[0]


@given(st.from_type(Grammar))
def test_legal_rules_are_those_of_the_symbol(grammar):
    assert (grammar.legal.sum(0)[1:] == 1).all()
    for v, name in enumerate(grammar.nonterminals):
        expected = [k for k, rule in enumerate(grammar.rules) if rule.lhs == name]
        assert grammar.rules_of(name) == grammar.legal[v].nonzero()[:, 0].tolist() == expected
        assert expected == list(range(expected[0], expected[-1] + 1))


@pytest.mark.parametrize(
    ("productions", "message"),
    [
        ("", "at least one production"),
        ("# only a comment", "at least one production"),
        ([], "at least one production"),
        ("Scene -> A x\n", r"Undefined nonterminal: A.*'A -> \.\.\.'"),
        ("Scene -> x(A)\n", "Undefined nonterminal: A"),
        ("Scene -> A B\nA -> x", "Undefined nonterminal: B"),
        ("Scene -> x\nA -> y", "Unreachable nonterminal: A"),
        ("Scene -> x\nA -> y B\nB -> A | z", "Unreachable nonterminal: A, B"),
        ("Scene -> x | y | x", "Duplicate production: 'Scene -> x' stands 2 times"),
        ("Scene -> x\nScene -> x", "Duplicate production"),
        ("Scene -> ε | eps", "Duplicate production: 'Scene -> ε'"),
        ("Scene -> x() | x", "Duplicate production: 'Scene -> x'"),
        ("Scene -> A\nA -> x A", "can never end: Scene, A"),
        ("Scene -> x | A\nA -> y B\nB -> A", "can never end: A, B"),
        ("scene -> x", "first letter upper-case"),
    ],
)
def test_faults_of_grammars(productions, message):
    with pytest.raises(GrammarError, match=message):
        Grammar(productions)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("Scene -> A\n\nA x y", 3, "expected 'Name -> symbols"),
        ("Scene", 1, "expected 'Name -> symbols"),
        ("Scene -> x\n# comment\nA B -> y", 3, "expected 'Name -> symbols"),
        ("-> x", 1, "expected 'Name -> symbols"),
        ("| x", 1, "expected 'Name -> symbols"),
        ("Scene -> A\nA -> x, y", 2, "expected names, brackets"),
        ("Scene -> A\nA ->", 2, "missing production"),
        ("Scene -> A\nA -> x |", 2, "missing production"),
        ("Scene -> A\nA -> x\n | | y", 3, "missing production"),
        ("Scene -> x(y", 1, r"'\(' without its '\)'"),
        ("Scene -> x(y | z)", 1, r"'\(' without its '\)'"),
        ("Scene -> x y)", 1, r"'\)' without its '\('"),
        ("Scene -> (x)", 1, "expected an object"),
        ("Scene -> A(x)\nA -> y", 1, "expected an object"),
        ("Scene -> x(y)(z)", 1, "expected an object"),
        ("Scene -> x ε", 1, "stands alone"),
        ("Scene -> A -> x", 1, "expected names, brackets"),
    ],
)
def test_faults_of_text_name_the_line(text, line, message):
    with pytest.raises(GrammarError, match=f"^Line {line}: .*{message}"):
        parse(text)


@pytest.mark.parametrize("name", ["x y", "x(y)", "ε", "eps", "", "y|z"])
def test_python_names_that_text_could_not_say(name):
    with pytest.raises(GrammarError, match="expected names of letters"):
        Rule("Scene", name)
    with pytest.raises(GrammarError, match="expected names of letters"):
        Rule("Scene", Node("x", ("z", name)))
    with pytest.raises(GrammarError, match="expected names of letters"):
        Rule(name, "x")


def test_python_nodes_that_are_no_objects():
    with pytest.raises(GrammarError, match="below an object"):
        Rule("Scene", Node("Plate", ("x",)))
    with pytest.raises(GrammarError, match="a tuple of children, got Node"):
        Rule("Scene", Node("plate", "Mugs"))


def test_a_childless_node_is_its_name_at_any_depth():
    assert Rule("Scene", Node("x", (Node("y"),))) == Rule("Scene", Node("x", ("y",)))
    with pytest.raises(GrammarError, match="Duplicate"):
        Grammar([Rule("Scene", Node("x", (Node("y"),))), Rule("Scene", Node("x", ("y",)))])


def test_unknown_names():
    grammar = Grammar(TABLETOP)
    with pytest.raises(GrammarError, match="nonterminal among .*got 'Cup'"):
        grammar.rules_of("Cup")
    with pytest.raises(GrammarError, match="object among .*got 'cup'"):
        grammar.kind("cup")
