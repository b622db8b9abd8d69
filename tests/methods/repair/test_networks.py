"""Networks, their low-rank updates and DDIM: laws that hold for any weights."""

import pytest
import torch

from visdom_plugin.errors import CheckpointError
from visdom_plugin.methods.repair.configs import LoraConfig, RepairConfig
from visdom_plugin.methods.repair.diffusion import Networks
from visdom_plugin.methods.repair.lora import LowRankUpdates
from visdom_plugin.methods.repair.weights import WeightsConfig, find_files
from visdom_plugin.seeding import generator


@pytest.fixture
def networks(networks_folder):
    return Networks(find_files(WeightsConfig(folder=networks_folder)), torch.device("cpu"))


@pytest.fixture(scope="module")
def picture():
    return torch.rand(64, 64, 3, generator=generator(0, "picture"))


def predict(networks, picture, text="a photo of a thing"):
    latent = networks.encode_image(picture, generator(0, "latent"))
    return networks.predict_noise(latent, torch.tensor(500), networks.encode_text(text), picture)


def test_text_and_hint_matter(networks, picture):
    with torch.no_grad():
        found = predict(networks, picture)
        assert torch.equal(found, predict(networks, picture))
        assert not torch.equal(found, predict(networks, picture, "a photo of two things"))
        # ControlNet's last layers are zero before it is trained.
        for name, parameter in networks.controlnet.named_parameters():
            if name.startswith(("controlnet_down", "controlnet_mid")):
                parameter.fill_(0.1)
        assert not torch.equal(found, predict(networks, picture))


@pytest.mark.parametrize("eta", [0.0, 1.0])
@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_networks_that_know_the_picture_draw_it_whatever_the_noise(
    networks, picture, monkeypatch, eta, strength
):
    truth = networks.encode_image(picture, generator(0, "truth"))

    def know(latent, t, text, hint):
        share = networks.alpha_bars[int(t)]
        return (latent - share.sqrt() * truth) / (1 - share).sqrt()

    monkeypatch.setattr(networks, "predict_noise", know)
    monkeypatch.setattr(networks, "decode", lambda latent: latent)
    config = RepairConfig(eta=eta, ddim_steps=20)
    found, score = networks.repair(torch.zeros_like(picture), "a photo", strength, config, generator(1))
    # The noise of the schedule's first step, of deviation 0.03, is what DDIM ends with.
    assert (found - truth).square().mean().sqrt() < 0.04 < 0.5 * truth.square().mean().sqrt()
    assert 0 < score < 1


def test_more_noise_counts_more_and_the_released_weights_are_of_the_steps_number(networks, picture):
    scores = [
        networks.repair(picture, "a photo", strength, RepairConfig(ddim_steps=4), generator(0))[1]
        for strength in (0.1, 0.5, 1.0)
    ]
    timesteps = (1, 251, 751)
    assert scores == [pytest.approx(1 - float(networks.alpha_bars[t])) for t in timesteps]
    released = RepairConfig(ddim_steps=4, score="released")
    assert networks.repair(picture, "a", 0.5, released, generator(0))[1] == pytest.approx(
        1 - float(networks.alpha_bars[2])
    )


def test_guidance_of_one_asks_once_and_another_twice(networks, picture, monkeypatch):
    calls = []
    real = networks.predict_noise
    monkeypatch.setattr(networks, "predict_noise", lambda *args: calls.append(1) or real(*args))
    for guidance, expected in ((1.0, 3), (2.0, 6)):
        calls.clear()
        networks.repair(picture, "a", 1.0, RepairConfig(ddim_steps=3, guidance=guidance), generator(0))
        assert len(calls) == expected


def test_updates_change_nothing_at_first_and_leave_the_weights_alone(networks, picture):
    with torch.no_grad():
        before = predict(networks, picture)
    frozen = {k: v.clone() for k, v in networks.unet.state_dict().items()}
    updates = LowRankUpdates(networks, LoraConfig(rank=2, alpha=4.0), seed=0)
    with torch.no_grad():
        assert torch.equal(before, predict(networks, picture))
    assert {name.partition(".")[0] for name in updates.parameters} == {"unet", "controlnet", "text_encoder"}
    updates.train(lr=0.05)
    target, losses = torch.zeros_like(before), []
    for _ in range(30):
        loss = (predict(networks, picture) - target).square().mean()
        loss.backward()
        updates.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.8 * losses[0]
    after = networks.unet.state_dict()
    for name, value in frozen.items():
        moved = (
            name
            if name in after
            else name.replace(".weight", ".base_layer.weight").replace(".bias", ".base_layer.bias")
        )
        assert torch.equal(value, after[moved]), name


def test_updates_start_alike_whatever_the_global_numbers_and_come_back(networks_folder, picture):
    made = []
    for luck in (1, 2):
        torch.manual_seed(luck)
        networks = Networks(find_files(WeightsConfig(folder=networks_folder)), torch.device("cpu"))
        made.append(LowRankUpdates(networks, LoraConfig(rank=2), seed=3))
    first, second = (updates.weights() for updates in made)
    assert all(torch.equal(first[name], second[name]) for name in first)
    with torch.no_grad():
        for parameter in made[0].parameters.values():
            parameter.add_(0.1)
    made[1].load_weights(made[0].weights())
    assert all(torch.equal(v, made[1].weights()[name]) for name, v in made[0].weights().items())
    with pytest.raises(CheckpointError, match="low-rank updates"):
        made[1].load_weights(dict(list(first.items())[1:]))
