"""Learnt structures beside labels."""

from types import SimpleNamespace

from probscene.app.evaluation.label_agreement import Agreement, HistogramComparison


def test_the_worst_of_labels_that_are_all_the_same():
    """As where each image shows one object: chance leaves them no distance."""
    found = {
        "a": HistogramComparison(0.0, 0.0, 0.0, 0.0),
        "b": HistogramComparison(0.5, 0.5, 0.0, 0.0),
        "c": HistogramComparison(0.3, 0.3, 0.1, 0.2),
    }
    assert Agreement.worst.fget(SimpleNamespace(histograms=found)) == "b"
