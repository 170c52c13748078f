"""The CUDA kernels that composite chunks, compared with torch and gsplat, and their compilation, which needs no GPU."""

import ctypes
from functools import cache
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not there for this system")
from helpers.cuda_on_cpu import COMPILER, kernels_on_cpu
from helpers.tile_lists import DEVICE, HEIGHT, TILE, WIDTH, ellipses, gradients, lists_of_all_lengths, rasterized

from drivesplat.kernels import torch_private
from drivesplat.kernels.cuda import compiled, compositing, scans
from drivesplat.kernels.triton import chunks
from drivesplat.kernels.triton.tiles import Footprints, TileLists, tile_lists

gpu = pytest.mark.gpu
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@pytest.mark.parametrize(
    ("program", "channels", "capability"),
    [
        *((compiled.IMAGES, count, "90") for count in (1, 4, chunks.MAX_VALUES)),
        *((compiled.SCANS, count, "80") for count in (0, scans.MAX_VALUES)),
        *((compiled.IMAGES_WITH_OBJECTS, 3, capability) for capability in ("75", "120")),
        *((compiled.SCANS, 2, capability) for capability in ("75", "120")),
    ],
)
def test_they_compile_for_each_number_of_values_and_kind_of_gpu(program, channels, capability):
    try:
        binary = compiled.compiled(program, channels, compiled.LENGTH, capability)
    except OSError as error:
        pytest.skip(f"no NVRTC: {error}")
    assert binary.startswith(b"\x7fELF")


def test_compiled_kernels_are_kept(monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr(compiled, "cache_folder", lambda *_: tmp_path / "cache")
    monkeypatch.setattr(compiled, "compiled", lambda *key: made.append(key) or b"%d" % len(made))
    programs = (compiled.IMAGES, 3), (compiled.IMAGES, 4), (compiled.SCANS, 3)
    for number, key in enumerate(programs * 2):
        assert compiled._binary(*key, 256, "90") == b"%d" % (number % 3 + 1)
    assert made == [(*key, 256, "90") for key in programs]


def test_where_the_cache_cannot_be_written_every_process_compiles(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(compiled, "cache_folder", lambda *_: tmp_path / "file" / "cache")
    monkeypatch.setattr(compiled, "compiled", lambda *_: b"kernels")
    assert compiled._binary(compiled.SCANS, 3, 256, "90") == b"kernels"


@pytest.mark.parametrize("error", [OSError("no NVRTC"), RuntimeError("fails:\nline 3"), AttributeError("renamed")])
def test_where_they_do_not_compile_others_replace_them_with_a_warning(monkeypatch, caplog, error):
    def fails(*_):
        raise error

    monkeypatch.setattr(compiled, "kernels", fails)
    compiled._compiles.cache_clear()
    assert not compiled._compiles(compiled.SCANS, 0) and not compiled._compiles(compiled.SCANS, 0)
    compiled._compiles.cache_clear()
    (record,) = caplog.records
    assert f"kernels of scans cannot be compiled ({str(error).splitlines()[0]})" in record.message
    assert "\n" not in record.message


def test_kernels_read_the_addresses_of_tensors_and_the_values_of_integers(monkeypatch):
    """With a driver of our own in place of CUDA's, which reads the arguments as a kernel does."""
    seen, tensors = [], [torch.zeros(3), torch.zeros(2, dtype=torch.int64)]

    def launch(function, *sizes_and_stream_and_arguments):
        *sizes, shared, stream, places, _ = sizes_and_stream_and_arguments
        pointers = [ctypes.cast(places[i], ctypes.POINTER(ctypes.c_void_p)).contents.value for i in (0, 2)]
        integers = [ctypes.cast(places[i], ctypes.POINTER(ctypes.c_int)).contents.value for i in (1, 3)]
        seen.append((function, sizes, shared, stream, pointers, integers))
        return 0

    monkeypatch.setattr(torch.cuda, "current_stream", lambda: SimpleNamespace(_as_parameter_="stream"))
    driver, kernel = SimpleNamespace(cuLaunchKernel=launch), SimpleNamespace(func="kernel")
    torch_private._launch(driver, kernel, 7, 128, [tensors[0], 5, tensors[1], 2**31 - 1])
    addresses = [tensor.data_ptr() for tensor in tensors]
    assert seen == [("kernel", [7, 1, 1, 128, 1, 1], 0, "stream", addresses, [5, 2**31 - 1])]


def test_programs_are_usable_one_by_one(monkeypatch):
    """Where those of scans alone do not compile, those of images are used."""
    on_gpu = SimpleNamespace(is_cuda=True, device=torch.device("cuda", 0))
    monkeypatch.setattr(torch.version, "hip", None)
    monkeypatch.setattr(compiled, "_compiles", lambda program, device: program is compiled.IMAGES)
    assert compiled.usable_for.__wrapped__(on_gpu, compiled.IMAGES)
    assert not compiled.usable_for.__wrapped__(on_gpu, compiled.SCANS)


@gpu
@needs_gpu
@pytest.mark.parametrize(("cameras", "channels"), [(1, 3), (2, 4), (1, 1), (1, 8)])
@pytest.mark.parametrize("length", [4, 256])
def test_chunks_and_their_gradients_equal_those_of_torch(cameras, channels, length):
    """For tiles with no entries, less than a chunk, a full chunk, and several chunks."""
    given, lists, expected = lists_of_all_lengths(cameras, channels, 1.0 / 255.0)
    found = compositing.composite(Footprints(*given), lists, WIDTH, HEIGHT, length)[:2]
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5)
    for theirs, mine in zip(*gradients(given, expected, found), strict=True):
        assert theirs.any()
        torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4)


@pytest.fixture(scope="module")
def kernels_of_a_processor(tmp_path_factory):
    """The source compiled for a processor, each program once."""
    folder = tmp_path_factory.mktemp("kernels")
    return cache(lambda program, channels, length, device: kernels_on_cpu(program, channels, length, folder))


@pytest.fixture
def on_the_processor(kernels_of_a_processor, monkeypatch):
    """The source compiled for a processor in place of the kernels."""
    if torch.cuda.is_available():
        pytest.skip("on a GPU the kernels themselves are compared")
    if COMPILER is None:
        pytest.skip("no C++ compiler")
    monkeypatch.setattr(compositing, "kernels", kernels_of_a_processor)


@pytest.fixture(params=["processor", pytest.param("GPU", marks=[gpu, needs_gpu])])
def anywhere(request):
    """The kernels on a GPU, and without one their source compiled for a processor."""
    if request.param == "processor":
        request.getfixturevalue("on_the_processor")


WITH_IMAGE, ALONE = slice(0, 3), slice(2, 3)


@pytest.mark.usefixtures("anywhere")
@pytest.mark.parametrize(
    ("channels", "compared", "length"),
    [(3, WITH_IMAGE, 4), (3, ALONE, 4), pytest.param(4, WITH_IMAGE, 256, marks=[gpu, needs_gpu])],
)
def test_the_alpha_of_objects_alone_and_its_gradient_equal_those_of_torch(channels, compared, length):
    """Images, alpha, alpha of objects alone, and the gradients of the `compared` ones of these."""
    given, lists, (image, alpha) = lists_of_all_lengths(1, channels, 1.0 / 255.0)
    objects = slice(8, 21)
    *others, opacities = given
    within = torch.zeros_like(opacities)
    within[:, objects] = 1.0
    alone = rasterized(
        *others, opacities * within, WIDTH, HEIGHT, TILE, lists.offsets[:-1].reshape(lists.tiles),
        lists.ids[lists.order[: int(lists.offsets[-1])]], least=1.0 / 255.0,
    )[1]  # fmt: skip
    assert float(alone.detach().max()) > 0.1 and float((alpha - alone).detach().max()) > 0.1
    found = compositing.composite(Footprints(*given), lists, WIDTH, HEIGHT, length, objects=objects)[:3]
    expected = (image, alpha, alone)
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5)
    for theirs, mine in zip(*gradients(given, expected[compared], found[compared]), strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4)


def one_after_the_other(given: list[torch.Tensor], objects: slice) -> tuple[torch.Tensor, ...]:
    """The image of one tile, its alpha, that of `objects` alone, and which rays do not end, in torch, with rays that
    end as in the kernels."""
    means, conics, values, opacities = (tensor[0] for tensor in given)
    at = torch.arange(TILE, device=DEVICE) + 0.5
    passes, past_objects = torch.ones(2, TILE, TILE, device=DEVICE)
    lives, image = torch.ones(TILE, TILE, dtype=torch.bool, device=DEVICE), torch.zeros(TILE, TILE, 3, device=DEVICE)
    for i in range(len(means)):
        over_x, over_y = at[None, :] - means[i, 0], at[:, None] - means[i, 1]
        a, b, c = conics[i]
        falls = 0.5 * (a * over_x**2 + c * over_y**2) + b * over_x * over_y
        alpha = (opacities[i] * torch.exp(-falls)).clamp(max=0.999)
        alpha = torch.where(lives & (alpha >= 1.0 / 255.0), alpha, 0.0)
        lives = lives & (passes * (1.0 - alpha) > 1e-4)
        alpha = torch.where(lives, alpha, 0.0)
        image = image + (passes * alpha)[..., None] * values[i]
        passes = passes * (1.0 - alpha)
        past_objects = past_objects * (1.0 - alpha) if objects.start <= i < objects.stop else past_objects
    return image[None], 1.0 - passes[None, ..., None], 1.0 - past_objects[None, ..., None], lives


def in_chunks(given: list[torch.Tensor], objects: slice, length: int) -> tuple[torch.Tensor, ...]:
    """As `one_after_the_other`, in chunks of `length` that are composited by themselves and then joined."""
    passes, past_objects = torch.ones(2, 1, TILE, TILE, 1, device=DEVICE)
    image, lives = torch.zeros(1, TILE, TILE, 3, device=DEVICE), torch.ones(TILE, TILE, dtype=torch.bool, device=DEVICE)
    for begin in range(0, given[0].shape[1], length):
        chunk = [values[:, begin : begin + length] for values in given]
        own = slice(objects.start - begin, objects.stop - begin)
        shown, alpha, alone, goes_on = one_after_the_other(chunk, own)
        counts = lives[None, ..., None]
        image = image + torch.where(counts, passes, 0.0) * shown
        passes = torch.where(counts, passes * (1.0 - alpha), passes)
        past_objects = torch.where(counts, past_objects * (1.0 - alone), past_objects)
        lives = lives & goes_on & (passes[0, ..., 0] > 1e-4)
    return image, 1.0 - passes, 1.0 - past_objects, lives


def before_one_tile(generator: torch.Generator) -> tuple[list[torch.Tensor], TileLists]:
    """200 Gaussians, in front of and behind which rays of a tile end, and its list."""
    count = 200
    given = [
        torch.rand(1, count, 2, generator=generator) * 24.0 - 4.0,
        torch.tensor([0.05, 0.01, 0.08]) * (0.5 + torch.rand(1, count, 1, generator=generator)),
        torch.rand(1, count, 3, generator=generator),
        0.05 + 0.4 * torch.rand(1, count, generator=generator),
    ]
    ids, ends = torch.arange(count, device=DEVICE), torch.tensor([0, count], dtype=torch.int32, device=DEVICE)
    return [values.to(DEVICE).requires_grad_() for values in given], TileLists(ids.int(), ids, ends, (1, 1, 1))


@pytest.mark.usefixtures("anywhere")
@pytest.mark.parametrize("length", [pytest.param(256, marks=pytest.mark.slow), 48])
def test_rays_end_before_the_last_gaussian(length):
    """In two batches of a block, or in chunks."""
    generator, objects = torch.Generator().manual_seed(0), slice(60, 150)
    given, lists = before_one_tile(generator)
    *expected, lives = in_chunks(given, objects, length)
    assert 0.2 < lives.float().mean() < 0.8
    for found in (
        compositing.composite(Footprints(*given), lists, TILE, TILE, length, objects=objects)[:3],
        compositing.composite(Footprints(*given), lists, TILE, TILE, length)[:2],
    ):
        for mine, theirs in zip(found, expected, strict=False):
            torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-4)
        retained = [values.detach().requires_grad_() for values in given]
        both = in_chunks(retained, objects, length)[: len(found)]
        weights = [torch.rand(image.shape, generator=generator).to(DEVICE) for image in found]
        mine, theirs = (
            torch.autograd.grad(sum((w * image).sum() for w, image in zip(weights, images, strict=True)), inputs)
            for images, inputs in ((found, given), (both, retained))
        )
        for one, other in zip(mine, theirs, strict=True):
            torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)


@pytest.mark.usefixtures("anywhere")
def test_chunks_behind_the_end_of_a_ray_have_no_gradient():
    """Chunks are composited by themselves: a ray ends at most 1e-4 later than where Gaussians follow one another, and
    nothing in the chunks behind has a gradient."""
    given, lists = before_one_tile(torch.Generator().manual_seed(0))
    length, early, objects = 48, 144, slice(60, 150)
    *expected, _ = one_after_the_other(given, objects)
    *_, goes_on = one_after_the_other([values[:, :early] for values in given], objects)
    assert 0.1 < goes_on.float().mean() < 0.9
    found = compositing.composite(Footprints(*given), lists, TILE, TILE, length, objects=objects)[:3]
    for mine, theirs in zip(found[:2], expected[:2], strict=True):
        torch.testing.assert_close(mine, theirs, atol=2e-4, rtol=0.0)
    behind = torch.autograd.grad(sum(image[:, ~goes_on].sum() for image in found), given)
    assert all(gradient[:, :length].any() and not gradient[:, early:].any() for gradient in behind)


@pytest.mark.parametrize("place", [1, 2, 5])
def test_pixels_whose_rays_have_ended_are_left_out_of_later_chunks(place, on_the_processor):
    """A processor composites chunks one after the other. The first one ends the rays on the left of a tile: values that
    are no numbers in another chunk do not reach the image there. On the right those of the second chunk do."""
    length, count = 4, 24
    means, conics = torch.full((1, count, 2), 8.0), torch.tensor([1e-3, 0.0, 1e-3]).repeat(1, count, 1)
    means[:, :length, 0], conics[:, :length, 0] = 2.0, 0.1
    values = torch.ones(1, count, 3)
    values[:, length * place : length * (place + 1)] = torch.nan
    given = Footprints(means, conics, values, torch.full((1, count), 0.99))
    ids, ends = torch.arange(count), torch.tensor([0, count], dtype=torch.int32)
    image, alpha = compositing.composite(given, TileLists(ids.int(), ids, ends, (1, 1, 1)), TILE, TILE, length)[:2]
    assert float(alpha[:, :, 1:3].min()) > 0.99
    assert bool(image[:, :, 1:3].isfinite().all()) and bool(image[:, :, 12:].isnan().all()) == (place == 1)


@gpu
@needs_gpu
@pytest.mark.parametrize(("cameras", "channels"), [(1, 3), (2, 1)])
def test_images_and_gradients_equal_those_of_gsplat(cameras, channels):
    """Of long lists, each in one chunk, with opaque Gaussians that end rays. Alpha rounded to the other side of its
    limit is an exception at single pixels."""
    from gsplat import isect_offset_encode, isect_tiles, rasterize_to_pixels

    width, height = 150, 80
    gaussians, radii, depths = ellipses(cameras, 40_000 // cameras, width, height)
    given = [gaussians.means, gaussians.conics, gaussians.values[..., :channels].contiguous(), gaussians.opacities]
    given = [values.requires_grad_() for values in given]
    lists = tile_lists(Footprints(*given), radii, depths, width, height)
    longest = int(lists.offsets.diff().max())
    assert longest > chunks.LENGTH
    down, across = lists.tiles[1:]
    _, keys, ids = isect_tiles(given[0], radii, depths, TILE, across, down, n_images=cameras)
    offsets = isect_offset_encode(keys, cameras, across, down).reshape(lists.tiles)
    theirs = rasterize_to_pixels(*given, width, height, TILE, offsets, ids)
    found = compositing.composite(Footprints(*given), lists, width, height, longest)[:2]
    for mine, expected in zip(found, theirs, strict=True):
        off = (mine - expected).abs()
        assert float(off.mean()) < 1e-5 and float(off.max()) < 5e-3
    for expected, mine in zip(*gradients(given, theirs, found), strict=True):
        assert float((mine - expected).norm() / expected.norm()) < 1e-3


@gpu
@needs_gpu
def test_empty_lists_give_an_empty_image_and_no_gradient():
    given = [torch.zeros(1, 5, *tail, device=DEVICE).requires_grad_() for tail in ((2,), (3,), (3,), ())]
    unseen = torch.zeros(1, 5, 2, dtype=torch.int32, device=DEVICE)
    lists = tile_lists(Footprints(*given), unseen, torch.ones(1, 5, device=DEVICE), 20, 10)
    image, alpha = compositing.composite(Footprints(*given), lists, 20, 10)[:2]
    assert image.shape == (1, 10, 20, 3) and alpha.shape == (1, 10, 20, 1) and not image.any() and not alpha.any()
    assert not any(gradient.any() for gradient in torch.autograd.grad(image.sum() + alpha.sum(), given))
