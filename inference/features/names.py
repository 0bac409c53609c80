"""Names of pretrained networks; apart from the networks, whose library takes seconds to import."""

from probscene.errors import ProbsceneError

PRETRAINED = {"efficientnet": "efficientnet-lite0", "inception": "inception-v3", "resnet50": "resnet-50"}
CHOICES = "efficientnet, inception, inception=FILE, resnet50 or resnet50=FILE"


def network_name(choice: str, others: tuple[str, ...] = ()) -> str:
    """The name in a choice of a pretrained network, which is one of ``CHOICES``.

    Args:
        others: further choices there are, for the message.

    Raises:
        ProbsceneError: another word, or a file where there is none to give.
    """
    name, equals, file = choice.partition("=")
    if name not in PRETRAINED or (equals and (not file or name == "efficientnet")):
        own = ", or FILE.py:NAME" if others and "run" not in others else ""
        raise ProbsceneError(f"expected features among {', '.join([*others, CHOICES])}{own}, got {choice!r}.")
    return name
