"""The CUDA compiler: from `CUDA_HOME`, from PyPI in the version of torch, or installed on the system."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

from drivesplat.errors import DeviceError

FROM_PYPI_SINCE = 13
"""NVIDIA's packages on PyPI contain nvcc from CUDA 13 on; those for CUDA 12 contain only ptxas."""
EXTRAS = "nvcc,crt,nvvm,cccl,cudart"
ALTERNATIVES = (
    "install NVIDIA's CUDA toolkit {version} (https://developer.nvidia.com/cuda-toolkit-archive, or `conda create -p "
    "~/cuda-{version} -c conda-forge cuda-nvcc={version} cuda-cudart-dev={version} cuda-cccl={version} "
    "libcublas-dev libcusparse-dev libcusolver-dev cuda-version={version}`), then CUDA_HOME=/where/it/is make setup"
)


@dataclass(frozen=True)
class Toolkit:
    """A usable CUDA toolkit: its folder, its release as nvcc reports it ("13.0"), and where it comes from."""

    home: Path
    release: str
    origin: str


def provide_toolkit(torch_cuda: str) -> Toolkit:
    """A toolkit of torch's CUDA major version, installed into this environment if needed. Raises DeviceError."""
    if given := _cuda_home():
        toolkit = next(_with_nvcc([Path(given)], "CUDA_HOME"), None)
        if toolkit is None or not same_major(toolkit.release, torch_cuda):
            found = f"has nvcc {toolkit.release}" if toolkit else "has no bin/nvcc that runs"
            raise DeviceError(
                f"CUDA_HOME={given} {found}, but torch is built for CUDA {torch_cuda}; "
                "unset CUDA_HOME, or set it to a toolkit of that major version"
            )
        return toolkit
    reason = f"PyPI has no nvcc for CUDA {torch_cuda}"
    if int(torch_cuda.split(".")[0]) >= FROM_PYPI_SINCE:
        try:
            return _from_pypi()
        except DeviceError as error:
            reason = str(error)
    for toolkit in _with_nvcc(system_homes(), "installed on the system"):
        if same_major(toolkit.release, torch_cuda):
            return toolkit
    raise DeviceError(
        f"no CUDA compiler for torch's CUDA {torch_cuda}: {reason}, and none is installed; "
        + ALTERNATIVES.format(version=torch_cuda)
    )


def installed_toolkits() -> Iterator[Toolkit]:
    """The toolkit that CUDA_HOME names; without it that of this environment, then those of the system."""
    if given := _cuda_home():
        return _with_nvcc([Path(given)], "CUDA_HOME")
    return _with_nvcc([_environment_home(), *system_homes()], "installed")


def _cuda_home() -> str | None:
    return os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")


def _environment_home() -> Path:
    """The folder of the toolkit from PyPI in this environment."""
    return Path(sys.prefix) / "cuda-toolkit"


def _with_nvcc(homes: Iterable[Path], origin: str) -> Iterator[Toolkit]:
    for home in homes:
        if release := nvcc_release(home):
            yield Toolkit(home, release, origin)


def system_homes() -> Iterator[Path]:
    """The usual folders of toolkits: that of the nvcc in PATH, then /usr/local/cuda*."""
    nvcc = shutil.which("nvcc")
    around = [Path(nvcc).resolve().parent.parent] if nvcc else []
    for home in (*around, *sorted(Path("/usr/local").glob("cuda*"))):
        if (home / "include/cuda_runtime.h").is_file() or (home / "targets").is_dir():
            yield home


def nvcc_release(home: Path) -> str | None:
    """The release of the nvcc in a toolkit's folder, such as "13.0"; None if none runs."""
    try:
        output = subprocess.run([home / "bin/nvcc", "--version"], capture_output=True, text=True, check=False).stdout
    except OSError:
        return None
    match = re.search(r"release (\d+\.\d+)", output)
    return match[1] if match else None


def same_major(release: str, other: str) -> bool:
    """Whether two CUDA versions have the same major version, within which kernels and libraries are compatible."""
    return release.split(".")[0] == other.split(".")[0]


def _from_pypi() -> Toolkit:
    """NVIDIA's packages in the versions that torch depends on, arranged as a toolkit."""
    try:
        wanted = f"cuda-toolkit[{EXTRAS}]=={version('cuda-toolkit')}"
    except PackageNotFoundError:
        raise DeviceError("this torch did not come with NVIDIA's cuda-toolkit package") from None
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wanted]
    done = subprocess.run(pip, capture_output=True, text=True, check=False)
    if done.returncode:
        error = next((line for line in reversed(done.stderr.splitlines()) if "ERROR" in line), "pip failed")
        raise DeviceError(f"`pip install {wanted}` failed ({error.strip()})")
    nvcc = next(file for file in distribution("nvidia-cuda-nvcc").files or () if str(file).endswith("bin/nvcc"))
    home = arrange(Path(str(nvcc.locate())).parent.parent, _environment_home())
    toolkit = next(_with_nvcc([home], "from PyPI"), None)
    if toolkit is None:
        raise DeviceError(f"the nvcc of {wanted} does not run on this machine")
    return toolkit


def arrange(packages: Path, home: Path) -> Path:
    """Makes `home` a toolkit of links into `packages` (nvidia/cu13 in site-packages), which lacks lib64 and the
    unversioned library names that linkers need. Returns `home`."""
    shutil.rmtree(home, ignore_errors=True)
    libraries = home / "lib64"
    libraries.mkdir(parents=True)
    for name in ("bin", "include", "nvvm"):
        (home / name).symlink_to(packages / name)
    for library in sorted((packages / "lib").glob("lib*.so*")):
        (libraries / library.name).symlink_to(library)
        unversioned = libraries / (library.name.split(".so")[0] + ".so")
        if not unversioned.exists():
            unversioned.symlink_to(library)
    return home
