"""All optimizers of a model step together as each would by itself."""

import numpy as np
import pytest
import torch
from helpers.hand_made import actors_of, motion_through, track_of

from drivesplat.kernels import triton_support
from drivesplat.model.background import Background
from drivesplat.model.deformable import Deformable
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.train import GaussianSettings, TrainSettings
from drivesplat.training.optimizers import DeviceSchedule, make_optimizers, set_learning_rates
from drivesplat.training.schedule import Schedule

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]),
]


def a_model(device: str) -> SplatModel:
    """Background, an actor and a sky: rates of all kinds, some of them alike."""
    rng = np.random.default_rng(0)
    settings = GaussianSettings(sh_degree=1)
    part = Background.from_points(rng.uniform(-1, 1, (30, 3)), rng.uniform(0, 1, (30, 3)), settings, 2.0)
    track = track_of(motion_through([0.0, 0.5, 1.0], [[0.0, 0.0, 0.0]] * 3), "car", (1.0, 1.0, 1.0))
    return SplatModel([part, actors_of(track)], CubemapSky(3, torch.full((3,), 0.5), 1e-2)).to(device)


def give_gradients(model: SplatModel, step: int) -> None:
    """To all parameters but the sky's at every third step."""
    rng = np.random.default_rng(step)
    for name, parameter in model.named_parameters():
        drawn = torch.from_numpy(rng.normal(size=parameter.shape)).float().to(parameter.device)
        silent = not parameter.requires_grad or (name.startswith("sky") and step % 3 == 0)
        parameter.grad = None if silent else drawn


def test_states_exist_from_the_beginning():
    """Before a CUDA graph could capture their creation."""
    for name, optimizer in make_optimizers(a_model("cpu")).all():
        state = optimizer.state[optimizer.parameter]
        assert state["step"] == 0 and not state["exp_avg"].any() and not state["exp_avg_sq"].any(), name
        assert state["exp_avg"].shape == state["exp_avg_sq"].shape == optimizer.parameter.shape


@pytest.mark.parametrize("device", DEVICES)
def test_a_step_together_is_every_optimizers_own(device):
    settings, ends = TrainSettings(iterations=10), []
    for together in (True, False):
        model = a_model(device)
        optimizers = make_optimizers(model)
        for step in range(7):
            give_gradients(model, step)
            set_learning_rates(model, optimizers, Schedule.of(settings, 1), step)
            if together:
                optimizers.step()
                assert all(parameter.grad is None for parameter in model.parameters())
            else:
                for _, optimizer in optimizers.all():
                    optimizer.step()
        states = {name: optimizer.state_dict()["state"] for name, optimizer in optimizers.all()}
        ends.append((model.state_dict(), states))
    (mine, my_states), (theirs, their_states) = ends
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs) and mine.keys() == theirs.keys()
    assert my_states.keys() == their_states.keys() and len(my_states) > 8
    for name, state in their_states.items():
        assert state.keys() == my_states[name].keys()
        for key, values in state.items():
            assert all(torch.equal(values[part], my_states[name][key][part]) for part in values)
    assert not torch.equal(mine["parts.0.params.means"], a_model(device).state_dict()["parts.0.params.means"])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("kernels", [True, False])
def test_steps_at_device_rates_equal_those_of_adam(kernels, monkeypatch):
    """Which a CPU reads from the optimizers."""
    monkeypatch.setattr(triton_support, "usable_for", lambda _: kernels)
    settings, ends, places = TrainSettings(iterations=10), [], {}
    for device in ("cuda", "cpu"):
        model = a_model(device)
        optimizers, schedule = make_optimizers(model), DeviceSchedule(torch.device(device))
        for step in range(7):
            give_gradients(model, step)
            set_learning_rates(model, optimizers, Schedule.of(settings, 1), step)
            counted, rates = schedule.update(step, optimizers)
            optimizers.step(rates)
            assert int(counted) == step and (rates is None) == (device == "cpu")
            assert all(places.setdefault(name, place) is place for name, place in (rates or {}).items()), (
                "CUDA graphs need constant addresses"
            )
        ends.append({name: value.cpu() for name, value in model.state_dict().items()})
    torch.testing.assert_close(*ends, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("step", "factor"), [(0, 1.0), (5, 0.1), (10, 0.01)])
def test_rates_decay_that_parts_name_among_their_own_and_their_shared_parameters(step, factor):
    """Gaussians that shake to the end are blurred."""
    settings = TrainSettings(iterations=10)
    track = track_of(motion_through([0.0, 0.5, 1.0], [[0.0, 0.0, 0.0]] * 3), "walker", (1.0, 1.0, 1.0))
    points, colors = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 20, 3))
    people = Deformable.from_points([track], [points], [colors + 0.5], settings.deformable, settings.gaussians)
    model = SplatModel([a_model("cpu").parts[0], people], None)
    optimizers = make_optimizers(model)
    before = {name: optimizer.param_groups[0]["lr"] for name, optimizer in optimizers.all()}
    set_learning_rates(model, optimizers, Schedule.of(settings, 1), step)
    decaying = {name for name in before if name.endswith(("means", "lattice", "stride", "phase"))}
    assert len(decaying) == 5
    for name, optimizer in optimizers.all():
        expected = (factor if name in decaying else 1.0) * before[name]
        assert optimizer.param_groups[0]["lr"] == pytest.approx(expected), name
