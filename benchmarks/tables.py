"""Writes the tables of README and docs from results that benchmarks have left, so that a command makes each figure.

    python benchmarks/tables.py [--check]
    python benchmarks/tables.py --take runs/benchmarks/ablate/multi_mnist/results.json --as ablate-multi_mnist

A page has a table, and the command of its figures, between ``<!-- table: NAME -->`` and ``<!-- end of table -->``. They
come from ``docs/figures/NAME.json``; the part of NAME before its first ``-`` is the benchmark that wrote the file. With
``--take`` a result file becomes NAME's. With ``--check`` nothing is written; the exit status is 1 where a page differs.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from probscene.app.files import write_text

ROOT = Path(__file__).resolve().parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
FIGURES = ROOT / "docs" / "figures"
BLOCK = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
Rows = list[list[str]]


def ablate(result: dict) -> Rows:
    """A row for each variant; log q as what is missing to the floor of the same seed, for each seed has its target."""
    rows: Rows = [["", "settings", "total variation", "log q below the floor's", "cannot derive"]]
    floors = {row["seed"]: row["log_q"] for row in result["rows"] if row["variant"] == "floor"}
    for variant in dict.fromkeys(row["variant"] for row in result["rows"]):
        each = [row for row in result["rows"] if row["variant"] == variant]
        settings, impossible = each[0]["settings"], spread([row["impossible"] for row in each], 2)
        below = spread([floors[row["seed"]] - row["log_q"] for row in each], 2)
        rows.append([variant, f"`{settings}`" if settings else "", spread([row["total_variation"] for row in each], 3)])
        rows[-1] += [below, impossible if any(row["impossible"] for row in each) else "none"]
    return rows


def learn_looks(result: dict) -> Rows:
    """A row for each hidden site, then the cars and KID; a column for each target."""
    targets = result["rows"]
    rows: Rows = [["", *(f"target {row['seed']}" for row in targets)]]
    for name in dict.fromkeys(name for row in targets for name, site in row["sites"].items() if site["hidden"]):
        rows.append([f"`{name}`", *(_of_site(row["sites"].get(name)) for row in targets)])
    rows.append(["others that are learnt", *(_others(row["sites"]) for row in targets)])
    rows.append(["number of cars, TV, start", *(f"{row['cars']['start']:.2f}" for row in targets)])
    rows.append(["number of cars, TV, learnt", *(f"{row['cars']['learnt']:.2f}" for row in targets)])
    for source in ("prior", "start", "structure", "both", "floor"):
        said = "learnt structure alone" if source == "structure" else source
        rows.append([f"KID, {said}", *(_figure(row["kid"][source]) for row in targets)])
    return rows


def learn_driving(result: dict) -> Rows:
    """Two rows for each source, of cars, then the other classes' total variation; a column for each target."""
    targets, sources = result["rows"], ("prior", "start", "learnt", "floor")
    rows: Rows = [["", *(f"target {row['seed']}" for row in targets), "mean"]]
    for distance, said in (("total_variation", "cars, TV"), ("wasserstein", "cars, Wasserstein-1")):
        for source in sources:
            each = [row[source]["car"][distance] for row in targets]
            figures = [f"{value:.3f} ({low:.3f} to {high:.3f})" for value, low, high in each]
            rows.append([f"{said}, {source}", *figures, f"{np.mean([value for value, *_ in each]):.3f}"])
    for name in (name for name in targets[0]["learnt"] if name != "car"):
        each = [[row[source][name]["total_variation"][0] for source in sources] for row in targets]
        figures = [", ".join(f"{value:.2f}" for value in four) for four in (*each, np.mean(each, 0))]
        rows.append([f"{name}, TV, the four in the same order", *figures])
    return rows


def learn_generator(result: dict) -> Rows:
    """A row for each quantity, the mean of the seeds and their range."""
    sources = ("prior", "start", "learnt", "floor")
    rows: Rows = [["total variation", *sources]]
    for quantity in (name for name in result["rows"][0]["learnt"] if name != "mean"):
        rows.append([quantity, *(spread([row[source][quantity] for row in result["rows"]], 3) for source in sources)])
    return rows


def learn_labelled(result: dict) -> Rows:
    """A row for each source and class, total variation and Wasserstein-1; a column for each seed, and their mean."""
    seeds, sources = result["rows"], ("prior", "start", "learnt", "labels alone", "floor")
    rows: Rows = [["total variation, Wasserstein-1", *(f"seed {row['seed']}" for row in seeds), "mean"]]
    for name, distances in seeds[0]["distances"].items():
        for source in (source for source in sources if source in distances):
            each = [row["distances"][name][source] for row in seeds]
            said = {"labels alone": "the labelled few alone", "floor": "as many labels drawn anew"}.get(source, source)
            rows.append([f"{name}, {said}", *(f"{tv:.2f}, {w1:.2f}" for tv, w1 in (*each, np.mean(each, 0)))])
    return rows


def learn_tilting(result: dict) -> Rows:
    """A row for each sort of features and source, then the sites; a column for each seed."""
    seeds = result["rows"]
    rows: Rows = [["squared energy distance", *(f"seed {row['seed']}" for row in seeds)]]
    for sort, said in (("efficientnet", "EfficientNet's features"), ("plain", "what plainly can be said")):
        for source in ("prior", "start", "learnt", "floor"):
            each = ("{:.3f} ({:.3f} to {:.3f})".format(*row[sort][source]) for row in seeds)
            rows.append([f"{said}, {source}", *each])
    rows.append(["sites that are moved", *(", ".join(f"`{site}`" for site in row["moved"]) for row in seeds)])
    return rows


def _of_site(site: dict | None) -> str:
    if site is None:
        return ""
    prior, (learnt, low, high) = site["prior"][0], site["learnt"]
    skill = "not read" if site["skill"] is None else f"skill {site['skill']:.2f}"
    if not site["is_learnt"]:
        return f"{skill}; {prior:.3f}, kept"
    return f"{skill}; {prior:.3f} to {learnt:.3f} ({low:.3f} to {high:.3f})"


def _others(sites: dict[str, dict]) -> str:
    said = (
        f"`{name}` {site['prior'][0]:.3f} to {site['learnt'][0]:.3f}"
        for name, site in sites.items()
        if not site["hidden"]
    )
    return ", ".join(said) or "none"


def _figure(figure: dict) -> str:
    return f"{figure['value']:.3f} ({figure['low']:.3f} to {figure['high']:.3f})"


TABLES: dict[str, Callable[[dict], Rows]] = {
    "ablate": ablate,
    "learn_driving": learn_driving,
    "learn_generator": learn_generator,
    "learn_labelled": learn_labelled,
    "learn_looks": learn_looks,
    "learn_tilting": learn_tilting,
}


def spread(values: list[float], digits: int) -> str:
    """Mean and range."""
    known = [value for value in values if value is not None and np.isfinite(value)]
    if not known:
        return ""
    low, mean, high = (f"{value:.{digits}f}" for value in (min(known), float(np.mean(known)), max(known)))
    return mean if low == high else f"{mean} ({low} to {high})"


def table(name: str) -> str:
    """What stands in a page between the marks."""
    path = FIGURES / f"{name}.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    head, *rows = (f"| {' | '.join(row)} |" for row in TABLES[name.partition("-")[0]](result))
    ruled = "|" + "---|" * (head.count("|") - 1)
    return "\n".join(["", f"    {result['command']}", "", head.replace("|  |", "| |"), ruled, *rows, ""])


def written(text: str) -> str:
    """A page with its tables as the result files say."""
    return BLOCK.sub(lambda found: f"{found[1]}{table(found[2])}\n{found[3]}", text)


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 where a page differs")
    parser.add_argument("--take", type=Path, metavar="FILE", help="a benchmark's results.json")
    parser.add_argument("--as", dest="name", help="the table that it is of")
    args = parser.parse_args()
    if bool(args.take) != bool(args.name) or (args.name and args.name.partition("-")[0] not in TABLES):
        parser.error(f"expected --take FILE with --as NAME, its first part one of {', '.join(TABLES)}.")
    if args.take:
        FIGURES.mkdir(exist_ok=True)
        write_text(FIGURES / f"{args.name}.json", args.take.read_text(encoding="utf-8"))
    stale = {page: text for page in PAGES if (text := written(before := page.read_text(encoding="utf-8"))) != before}
    for page, text in stale.items():
        print(f"{page.relative_to(ROOT)}: {'differs' if args.check else 'written'}")
        if not args.check:
            write_text(page, text)
    sys.exit(1 if args.check and stale else 0)


if __name__ == "__main__":
    main()
