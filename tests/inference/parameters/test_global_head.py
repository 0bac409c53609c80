"""What is read of the whole scene."""

import torch

from probscene.inference.parameters.global_head import GlobalHead, global_features
from probscene.inference.parameters.reader import HARMONICS, normal, truncated_mean
from probscene.inference.parameters.reader_training import GlobalHeadTraining

RENDERS = 600


def views(number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Images with a bright sky above a horizon, and ``(N, 2)`` u of where it is and of how bright all is."""
    u = torch.rand(number, 2)
    row = torch.arange(40)[None, :, None] + 0.5
    sky = (12 + 16 * u[:, :1, None] - row).clamp(0, 1)
    image = (0.3 + 0.4 * sky + 0.05 * torch.rand(number, 40, 60)) * (0.8 + 0.4 * u[:, 1:, None])
    return (255 * image).round().to(torch.uint8).unsqueeze(1), u


def with_gaps(number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Scenes of which every other one has no second site."""
    images, u = views(number)
    u[::2, 1] = torch.nan
    return images, u


def trained(draw, seed: int = 0) -> GlobalHead:
    torch.manual_seed(0)
    net = GlobalHead(2, 2 + HARMONICS)
    GlobalHeadTraining(net, draw, RENDERS, seed=seed).run()
    return net


def test_a_horizon_and_an_exposure_are_read_from_few_renders_and_where_some_have_no_site():
    net = trained(with_gaps)
    torch.manual_seed(1)
    images, u = views(200)
    with torch.no_grad():
        read = truncated_mean(*normal(net(images)))
    assert ((1 - 12 * (read - u).square().mean(0)) > 0.9).all()


def test_no_more_renders_are_drawn_than_asked_for():
    number = []

    def counted(num: int):
        number.append(num)
        return views(num)

    trained(counted)
    assert sum(number) == RENDERS


def test_what_was_interrupted_ends_the_same():
    whole = trained(views).state_dict()
    states, again = [], GlobalHead(2, 2 + HARMONICS)
    torch.manual_seed(0)
    net = GlobalHead(2, 2 + HARMONICS)
    training = GlobalHeadTraining(net, views, RENDERS)

    def stop(some, _):
        if some.done == 130:
            states.append({key: value.clone() for key, value in some.state().items()})

    training.run(stop)
    other = GlobalHeadTraining(again, views, RENDERS)
    other.restore(states[0])
    assert other.done == 130
    other.run()
    for key, value in whole.items():
        assert torch.equal(again.state_dict()[key], value), key


def test_grey_and_colour_bytes_and_floats_look_the_same():
    torch.manual_seed(0)
    images, _ = views(3)
    known = global_features(images)
    assert torch.allclose(known, global_features(images.expand(-1, 3, -1, -1)), atol=1e-5)
    assert torch.allclose(known, global_features(images / 255), atol=1e-5)
