"""Plain data as typed records: arrays of one record agree on the sizes of their named dimensions."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float, Int

from drivesplat.io.typed_record import typed_record


@dataclass(frozen=True)
class Track:
    times: Int[np.ndarray, " n"]
    poses: Float[np.ndarray, "n 4 4"]
    weights: Float[np.ndarray, " k"] | None = None


@dataclass(frozen=True)
class Tracks:
    first: Track
    second: Track


def values(times: int, poses: int, **others) -> dict:
    return {"times": np.zeros(times, dtype=np.int64), "poses": np.zeros((poses, 4, 4)), **others}


def test_a_named_dimension_has_one_size_in_all_arrays_of_a_record():
    made = typed_record(Track, values(3, 3, weights=np.zeros(5)))
    assert len(made.times) == len(made.poses) == 3 and made.weights is not None and len(made.weights) == 5
    with pytest.raises(ValueError, match=r"poses is float64 \[2, 4, 4\], not Float"):
        typed_record(Track, values(3, 2))


def test_records_within_a_record_have_sizes_of_their_own():
    made = typed_record(Tracks, {"first": values(3, 3), "second": values(1, 1)})
    assert len(made.first.times) == 3 and len(made.second.times) == 1
    with pytest.raises(ValueError, match="poses is"):
        typed_record(Tracks, {"first": values(3, 3), "second": values(1, 3)})


def test_an_array_of_another_shape_or_type_is_refused():
    with pytest.raises(ValueError, match=r"times is float64 \[3\]"):
        typed_record(Track, {**values(3, 3), "times": np.zeros(3)})
    with pytest.raises(ValueError, match=r"poses is float64 \[3, 4, 3\]"):
        typed_record(Track, {**values(3, 3), "poses": np.zeros((3, 4, 3))})


def test_reading_a_record_imports_no_jax(tmp_path: Path):
    traceback_util = tmp_path / "jax" / "_src" / "traceback_util.py"
    traceback_util.parent.mkdir(parents=True)
    traceback_util.write_text("def register_exclusion(path): pass\n")
    for folder in ("jax", "jax/_src"):
        (tmp_path / folder / "__init__.py").touch()
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from drivesplat.io.typed_record import typed_record\n"
        "from dataclasses import make_dataclass; import numpy as np; from jaxtyping import Float\n"
        "kind = make_dataclass('Kind', [('a', Float[np.ndarray, 'n 3'])])\n"
        "typed_record(kind, {'a': np.zeros((2, 3))})\n"
        "print('jax' in sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"
