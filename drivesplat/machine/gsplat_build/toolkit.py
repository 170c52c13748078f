"""The CUDA compiler: the one `CUDA_HOME` names, one from PyPI that matches torch, or one installed on the system."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

from drivesplat.errors import DeviceError

FROM_PYPI_SINCE = 13
"""NVIDIA's packages on PyPI hold nvcc itself from CUDA 13 on; those for CUDA 12 hold ptxas alone."""
EXTRAS = "nvcc,crt,nvvm,cccl,cudart"
OTHER_WAYS = (
    "install NVIDIA's CUDA toolkit {version} (https://developer.nvidia.com/cuda-toolkit-archive, or `conda create -p "
    "~/cuda-{version} -c conda-forge cuda-nvcc={version} cuda-cudart-dev={version} cuda-cccl={version} "
    "libcublas-dev libcusparse-dev libcusolver-dev cuda-version={version}`), then CUDA_HOME=/where/it/is make setup"
)


@dataclass(frozen=True)
class Toolkit:
    """A usable CUDA toolkit."""

    home: Path
    release: str
    """As nvcc names it: 13.0."""
    origin: str


def provide_toolkit(torch_cuda: str) -> Toolkit:
    """A toolkit of torch's CUDA major version, installed into this environment where need be. Raises DeviceError."""
    given = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    if given:
        release = nvcc_release(Path(given))
        if release is None or not same_major(release, torch_cuda):
            found = f"holds nvcc {release}" if release else "holds no bin/nvcc that runs"
            raise DeviceError(
                f"CUDA_HOME={given} {found}, but torch is built for CUDA {torch_cuda}; "
                "unset CUDA_HOME, or let it name a toolkit of that major version"
            )
        return Toolkit(Path(given), release, "CUDA_HOME")
    reason = f"PyPI has no nvcc for CUDA {torch_cuda}"
    if int(torch_cuda.split(".")[0]) >= FROM_PYPI_SINCE:
        try:
            return _from_pypi()
        except DeviceError as error:
            reason = str(error)
    for home in system_homes():
        release = nvcc_release(home)
        if release and same_major(release, torch_cuda):
            return Toolkit(home, release, "installed on the system")
    raise DeviceError(
        f"no CUDA compiler for torch's CUDA {torch_cuda}: {reason}, and none is installed; "
        + OTHER_WAYS.format(version=torch_cuda)
    )


def own_home() -> Path:
    """Where this environment keeps the toolkit from PyPI."""
    return Path(sys.prefix) / "cuda-toolkit"


def system_homes() -> Iterator[Path]:
    """Where installed toolkits usually are: around the nvcc in PATH, then /usr/local/cuda*."""
    nvcc = shutil.which("nvcc")
    around = [Path(nvcc).resolve().parent.parent] if nvcc else []
    for home in (*around, *sorted(Path("/usr/local").glob("cuda*"))):
        if (home / "include/cuda_runtime.h").is_file() or (home / "targets").is_dir():
            yield home


def nvcc_release(home: Path) -> str | None:
    """The release of the nvcc in a toolkit's folder, as "13.0"; None where none runs."""
    try:
        said = subprocess.run([home / "bin/nvcc", "--version"], capture_output=True, text=True, check=False).stdout
    except OSError:
        return None
    match = re.search(r"release (\d+\.\d+)", said)
    return match[1] if match else None


def same_major(release: str, other: str) -> bool:
    """Whether two CUDA versions share the number before the point: within it, kernels and libraries go together."""
    return release.split(".")[0] == other.split(".")[0]


def _from_pypi() -> Toolkit:
    """NVIDIA's packages at exactly the versions torch itself came with, and a folder that looks like a toolkit."""
    try:
        wanted = f"cuda-toolkit[{EXTRAS}]=={version('cuda-toolkit')}"
    except PackageNotFoundError:
        raise DeviceError("this torch did not come with NVIDIA's cuda-toolkit package") from None
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wanted]
    done = subprocess.run(pip, capture_output=True, text=True, check=False)
    if done.returncode:
        said = next((line for line in reversed(done.stderr.splitlines()) if "ERROR" in line), "pip failed")
        raise DeviceError(f"`pip install {wanted}` failed ({said.strip()})")
    home = arrange(_package_root(), own_home())
    release = nvcc_release(home)
    if release is None:
        raise DeviceError(f"the nvcc of {wanted} does not run on this machine")
    return Toolkit(home, release, "from PyPI")


def _package_root() -> Path:
    nvcc = next(file for file in distribution("nvidia-cuda-nvcc").files or () if str(file).endswith("bin/nvcc"))
    return Path(str(nvcc.locate())).parent.parent


def arrange(packages: Path, home: Path) -> Path:
    """Makes `home` a toolkit of links into `packages` (nvidia/cu13 in site-packages), which has neither lib64 nor the
    unversioned library names that linkers look for. Returns `home`."""
    shutil.rmtree(home, ignore_errors=True)
    libraries = home / "lib64"
    libraries.mkdir(parents=True)
    for name in ("bin", "include", "nvvm"):
        (home / name).symlink_to(packages / name)
    for library in sorted((packages / "lib").glob("lib*.so*")):
        (libraries / library.name).symlink_to(library)
        plain = libraries / (library.name.split(".so")[0] + ".so")
        if not plain.exists():
            plain.symlink_to(library)
    return home
