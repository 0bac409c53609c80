"""What is read of the whole scene."""

import torch

from probscene.inference.parameters.reading.overall import Overall, looks
from probscene.inference.parameters.reading.reader import HARMONICS, cut_mean, normal, value_loss
from probscene.inference.steps import StepTraining


def views(number: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Images with a bright sky above a horizon, and ``(N, 2)`` u of where it is and of how bright all is."""
    rng = torch.Generator().manual_seed(seed)
    u = torch.rand(number, 2, generator=rng)
    row = torch.arange(40)[None, :, None] + 0.5
    sky = (12 + 16 * u[:, :1, None] - row).clamp(0, 1)
    image = (0.3 + 0.4 * sky + 0.05 * torch.rand(number, 40, 60, generator=rng)) * (0.8 + 0.4 * u[:, 1:, None])
    return (255 * image).round().to(torch.uint8).unsqueeze(1), u


class Reading(StepTraining):
    """Of small batches of views."""

    def __init__(self, net):
        super().__init__(net, torch.optim.AdamW(net.parameters(), lr=4e-3), steps=300, seed=0, warming=30)
        self.net = net

    def loss(self):
        images, u = views(12, self.done)
        return value_loss(self.net(images, torch.zeros(12, 64, 2, 2)), u).sum()


def test_a_horizon_and_an_exposure_are_read_after_a_few_small_batches():
    torch.manual_seed(0)
    net = Overall(2, 2 + HARMONICS)
    Reading(net).run()
    images, u = views(200, 10**6)
    with torch.no_grad():
        read = cut_mean(*normal(net.eval()(images, torch.zeros(200, 64, 2, 2))))
    assert ((1 - 12 * (read - u).square().mean(0)) > 0.8).all()


def test_grey_and_colour_bytes_and_floats_look_the_same():
    images, _ = views(3, 0)
    known = looks(images)
    assert torch.allclose(known, looks(images.expand(-1, 3, -1, -1)), atol=1e-5)
    assert torch.allclose(known, looks(images / 255), atol=1e-5)


def test_what_is_said_of_an_image_does_not_depend_on_others():
    torch.manual_seed(0)
    net, (images, _) = Overall(1, 6), views(30, 1)
    seen = torch.rand(30, 64, 3, 4)
    for _ in range(3):
        net(images, seen)
    again = Overall(1, 6)
    again.load_state_dict(net.state_dict())
    with torch.no_grad():
        whole = net.eval()(images, seen)
        assert torch.allclose(whole[:4], again.eval()(images[:4], seen[:4]), atol=1e-5)
