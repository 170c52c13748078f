"""The CUDA kernels are called with arguments of the types in their source. Needs no GPU: nothing is launched."""

import re

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not there for this system")
from helpers.random_scans import even_rays, random_scan
from helpers.tile_lists import HEIGHT, WIDTH, lists_of_all_lengths

from drivesplat.kernels import triton_support
from drivesplat.kernels.cuda import compiled, compositing, scans
from drivesplat.kernels.triton.tiles import Footprints

KINDS = {torch.float32: "float*", torch.int32: "int*", torch.int64: "longlong*"}


def parameters(program: compiled.Program, kernel: str) -> list[str]:
    """The types of a kernel's parameters in the source, without const."""
    macros = dict(re.findall(r"#define (PARAMETERS|SIZES)\b((?:.*\\\n)*.*)", program.source))
    (found,) = re.findall(rf"\b{kernel}\(([^)]*)\)", program.source)
    for name, text in macros.items():
        found = re.sub(rf"\b{name}\b", lambda _, text=text: text.replace("\\\n", " "), found)
    return [re.sub(r"const|\s", "", re.sub(r"\w+\s*$", "", parameter)) for parameter in found.split(",")]


@pytest.fixture
def launched(monkeypatch) -> list[tuple[str, list[str]]]:
    """The kernels launched, each with the types of its arguments."""
    seen = []

    def kernels(program, channels, length, device):
        def launch(name):
            def run(blocks, threads, arguments):
                assert blocks > 0 and threads % 32 == 0
                assert all(given.is_contiguous() for given in arguments if isinstance(given, torch.Tensor))
                types = ["int" if isinstance(given, int) else KINDS[given.dtype] for given in arguments]
                seen.append((program, name, types))

            return run

        return {name: launch(name) for name in program.kernels}

    for module in (compositing, scans):
        monkeypatch.setattr(module, "kernels", kernels)
    return seen


def check(launched, program: compiled.Program) -> None:
    assert {name for _, name, _ in launched} == set(program.kernels)
    for given, name, types in launched:
        assert given is program and types == parameters(program, name), name


@pytest.mark.skipif(torch.cuda.is_available(), reason="on a GPU the kernels themselves are compared")
def test_kernels_of_images(launched):
    given, lists, _ = lists_of_all_lengths(1, 3, 1.0 / 255.0)
    image, alpha = compositing.composite(Footprints(*given), lists, WIDTH, HEIGHT)[:2]
    torch.autograd.grad(image.sum() + alpha.sum(), given)
    check(launched, compiled.IMAGES)
    launched.clear()
    found = compositing.composite(Footprints(*given), lists, WIDTH, HEIGHT, objects=slice(3, 9))
    torch.autograd.grad(found.objects_alpha.sum(), given)
    check(launched, compiled.IMAGES_WITH_OBJECTS)


@pytest.mark.skipif(torch.cuda.is_available(), reason="on a GPU the kernels themselves are compared")
def test_kernels_of_scans(launched, monkeypatch):
    monkeypatch.setattr(triton_support, "usable_for", lambda tensor: True)
    monkeypatch.setattr(scans, "can_composite", lambda values: True)
    scene = random_scan(0, n=20, rays=even_rays(3, 40)).float()
    scene.means.requires_grad_()
    rendering = scene.render("cpu")
    torch.autograd.grad(rendering.range.sum() + rendering.values.sum(), scene.means)
    check(launched, compiled.SCANS)
