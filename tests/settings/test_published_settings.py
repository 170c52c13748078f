"""Published figures in the config: what is accepted, and one clear sentence for what is not."""

from typing import Any, get_args

import pytest

from drivesplat.errors import ConfigError
from drivesplat.scene.regions import REGIONS
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.settings.config import load
from drivesplat.settings.published import PublishedFigures

ENTRY = {"source": "VAD-GS", "url": "https://arxiv.org/abs/2510.09364", "scene": "0061", "method": "PVG", "psnr": 22.77}


def without(key: str) -> dict[str, Any]:
    return {name: value for name, value in ENTRY.items() if name != key}


def test_figures_of_whole_images_between_training_images_are_the_default():
    (found,) = load({"published": [ENTRY]}).published
    assert (found.group, found.region, found.scenes, found.ssim) == ("interpolation", "all", None, None)
    assert load({}).published == ()
    fields = PublishedFigures.model_fields
    assert get_args(fields["group"].annotation) == HELD_OUT_GROUPS
    assert get_args(fields["region"].annotation) == tuple(REGIONS)


@pytest.mark.parametrize(
    ("published", "sentence"),
    [
        (ENTRY, "'published' is {'source': 'VAD-GS', .*: it must be a list, each entry of which begins with '- '"),
        (None, "'published' is None: it must be a list"),
        ([22.77], r"'published\.0' is 22.77: it must be a mapping"),
        ([ENTRY, without("url")], r"'published\.1\.url' is missing: docs/settings\.md says what it is"),
        (
            [{**ENTRY, "url": "VAD-GS"}],
            r"'published\.0\.url' is 'VAD-GS': it must be the address of a page, as https://",
        ),
        ([{**ENTRY, "url": "javascript:alert(1)"}], "must be the address of a page"),
        ([{**ENTRY, "scene": 61}], r"'published\.0\.scene' is 61: the name of a scene is a number to YAML"),
        ([{**ENTRY, "psnr": "22,77"}], r"'published\.0\.psnr' is '22,77': input should be a number"),
        ([{**ENTRY, "ssim": 65}], r"'published\.0\.ssim' is 65: input should be less than or equal to 1"),
        ([{**ENTRY, "train_minutes": 0}], r"'published\.0\.train_minutes' is 0: input should be greater than 0"),
        ([{**ENTRY, "lpip": 0.2}], r"unknown key 'published\.0\.lpip' \(value 0.2\)"),
        ([{**ENTRY, "region": "sky"}], r"'published\.0\.region' is 'sky': input should be 'all', 'static'"),
        ([without("psnr")], "no figure is given; give at least one of psnr, ssim, lpips, train_minutes"),
        ([{**ENTRY, "scenes": 6}], "scenes counts the scenes of a mean; set scene: mean, or leave it out"),
    ],
    ids=range(14),
)
def test_a_wrong_entry_is_refused_in_one_sentence(published, sentence):
    with pytest.raises(ConfigError, match=sentence) as refusal:
        load({"published": published})
    assert "\n" not in str(refusal.value) and str(refusal.value).count("published") == 1
