"""Words for devices, and the tests' own second device, which is none of them."""

import pytest
import torch
from second_device import second_device

from probscene.device import CPU, chosen_device, device_of
from probscene.errors import MachineError, ProbsceneError


def test_the_cpu_is_chosen_by_its_name():
    assert chosen_device("cpu") == CPU


@pytest.mark.parametrize("gpu", [False, True])
def test_auto_is_a_gpu_where_there_is_one(gpu, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert chosen_device("auto").type == ("cuda" if gpu else "cpu")


@pytest.mark.parametrize("word", ["gpu", "", "cuda:x", "meta", "cuda;1"])
def test_another_word_is_refused(word):
    with pytest.raises(ProbsceneError, match="auto, cpu, cuda, cuda:1 or mps"):
        chosen_device(word)


@pytest.mark.parametrize(
    ("word", "gpus", "remedy"), [("cuda:2", 2, "below 2"), ("cpu:1", 0, "below 1"), ("cuda", 0, "take")]
)
def test_a_device_that_is_not_there_is_refused(word, gpus, remedy, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    with pytest.raises(MachineError, match=remedy):
        chosen_device(word)


def test_a_device_has_one_name(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [str(chosen_device(word)) for word in ("cuda", "cuda:0", "cuda:1", "cpu:0")] == [
        "cuda",
        "cuda",
        "cuda:1",
        "cpu",
    ]


@pytest.fixture
def second():
    with second_device() as device:
        yield device


def test_tensors_of_two_devices_do_not_meet(second):
    here, there = torch.ones(3), torch.ones(3).to(second)
    for operation in (lambda: here + there, lambda: there.add_(here), lambda: torch.cat([here, there]),
                      lambda: here[there.long()]):  # fmt: skip
        with pytest.raises(RuntimeError, match="second device"):
            operation()
    with pytest.raises(RuntimeError, match="numpy"):
        there.numpy()
    assert (there[torch.tensor([0, 2])] + 1.0 + torch.tensor(2.0)).cpu().tolist() == [4.0, 4.0]


def test_a_training_there_has_the_bytes_of_one_on_the_cpu(second):
    def trained(device):
        torch.manual_seed(0)
        net = torch.nn.Sequential(torch.nn.Conv2d(1, 4, 3), torch.nn.BatchNorm2d(4), torch.nn.Dropout(0.5)).to(device)
        assert device_of(net) == device
        adam = torch.optim.AdamW(net.parameters())
        for _ in range(3):
            loss = net(torch.rand(2, 1, 8, 8).to(device)).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
        return [value.cpu() for value in net.state_dict().values()]

    assert all(torch.equal(*pair) for pair in zip(trained(CPU), trained(second), strict=True))
