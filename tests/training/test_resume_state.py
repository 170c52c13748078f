"""A resume state altered after it was written is refused, or the alteration does not reach what is resumed from."""

import logging
import random
import struct
import zipfile
from pathlib import Path

import pytest
from helpers.trainings import (
    CHECKPOINT_AT,
    ENDED_AT,
    ITERATIONS,
    EndedError,
    EndingViews,
    recorded_views,
    same_parameters,
    settings_of,
    trained,
)

from drivesplat.io import checkpoint_file
from drivesplat.training import resume_state

pytestmark = pytest.mark.usefixtures("one_thread")

FINGERPRINT = "of this training"
FLIPS = 30
LOCAL_HEADER = struct.Struct("<26xHH")


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory) -> Path:
    """The folder of an interrupted training."""
    folder = tmp_path_factory.mktemp("interrupted")
    with pytest.raises(EndedError):
        trained(folder, settings_of(), EndingViews(recorded_views(), ENDED_AT), fingerprint=FINGERPRINT)
    return folder


def headers(path: Path) -> list[int]:
    """The bytes of an archive outside its members' content: local headers, the directory and its end."""
    whole, content = path.read_bytes(), set()
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            begin = member.header_offset + LOCAL_HEADER.size
            begin += sum(LOCAL_HEADER.unpack(whole[member.header_offset : begin]))
            content.update(range(begin, begin + member.file_size))
    return [i for i in range(len(whole)) if i not in content]


def test_each_of_30_flipped_bits_of_a_resume_state_is_refused_or_without_effect(interrupted, tmp_path, caplog):
    """Half of them lie in the archive's headers, which no checksum covers."""
    path, written, chance = tmp_path / "state.npz", interrupted / "resume/state.npz", random.Random(22)
    whole, outside = written.read_bytes(), headers(written)
    places = [chance.choice(outside) if i % 2 else chance.randrange(len(whole)) for i in range(FLIPS)]
    refused = 0
    for place in places:
        altered = bytearray(whole)
        altered[place] ^= 1 << chance.randrange(8)
        path.write_bytes(altered)
        caplog.clear()
        content = resume_state.resumable(path, FINGERPRINT)
        if content is None:
            (message,) = caplog.messages
            assert message.startswith(f"{path}: not a file of arrays") and message.endswith("training starts at 0")
            refused += 1
        else:
            checkpoint_file.save(tmp_path / "again.npz", content)
            assert (tmp_path / "again.npz").read_bytes() == whole, f"byte {place} was read otherwise than written"
    assert FLIPS / 2 <= refused < FLIPS, "flips of both kinds"


def test_a_training_whose_resume_state_was_altered_starts_at_0_and_is_the_same(interrupted, tmp_path, caplog):
    whole, _ = trained(tmp_path / "whole", settings_of(), fingerprint=FINGERPRINT)
    state = interrupted / "resume/state.npz"
    content, values = bytearray(state.read_bytes()), checkpoint_file.load(state, "train")
    assert values["step"] == CHECKPOINT_AT
    means = values["state"]["model"]["parts.0.params.means"].numpy().tobytes()
    content[content.index(means) + len(means) // 2] ^= 1
    (tmp_path / "it/resume").mkdir(parents=True)
    (tmp_path / "it/resume/state.npz").write_bytes(content)
    with caplog.at_level(logging.WARNING):
        model, summary = trained(tmp_path / "it", settings_of(), fingerprint=FINGERPRINT)
    assert "parts.0.params.means.npy" in caplog.text and "training starts at 0" in caplog.text
    assert summary.resumed_at == [] and summary.iterations == ITERATIONS
    assert same_parameters(model, whole)
