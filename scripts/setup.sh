#!/usr/bin/env bash
# Makes .venv with everything the workflow needs, and compiles gsplat where there is an NVIDIA GPU; leaves what is good
# alone. docs/installation.md tells of the variables: PYTHON, TORCH_CUDA, TORCH_INDEX, GSPLAT_ARCHS, MAX_JOBS.
#   scripts/setup.sh            do it
#   scripts/setup.sh --check    say what it would find wrong, and change nothing
set -euo pipefail
cd "$(dirname "$0")/.."
PATH=$PATH:/usr/lib/wsl/lib  # where Windows' Linux keeps nvidia-smi

readonly stamp=.venv/.made-from
readonly compiled=.venv/.compiled-ahead
readonly torch_index=${TORCH_INDEX:-https://download.pytorch.org/whl}
readonly os_release=${OS_RELEASE:-/etc/os-release}

say() { echo "setup: $*" >&2; }
fail() { say "$@"; exit 1; }

# The stamp: a digest of what is required, and the build of torch where it is not PyPI's.
requirements() { cat requirements.txt requirements-dev.txt constraints.txt | sha256sum | cut -d' ' -f1; }
build_made() { local digest build; read -r digest build 2>/dev/null < "$stamp" || true; echo "${build:-cu130}"; }
stamp_for() { if [ "$1" = cu130 ]; then requirements; else echo "$(requirements) $1"; fi; }

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }

# Prints the interpreter to make .venv with; says what to install where there is none.
find_python() {
  local candidate version seen="" bare="" candidates=(python3.11 python3.12 python3.13 python3 python)
  if [ -n "${PYTHON:-}" ]; then candidates=("$PYTHON"); fi
  for candidate in "${candidates[@]}"; do
    command -v "$candidate" >/dev/null 2>&1 || continue
    version=$(version_of "$candidate") || continue
    case $version in
      3.11|3.12|3.13) ;;
      *) seen="$seen, $candidate is $version"; continue ;;
    esac
    if "$candidate" -c 'import venv, ensurepip' 2>/dev/null; then
      # an activated .venv must not be what makes the new one
      "$candidate" -c 'import sys; print(sys._base_executable)'
      return
    fi
    bare=${bare:-$version}
  done
  if [ -n "$bare" ]; then
    say "Python $bare is there, but not its venv module: sudo apt-get install python$bare-venv, then make setup"
  else
    say "no Python 3.11 to 3.13 found${PYTHON:+ at PYTHON=$PYTHON}${seen:+ (${seen#, })}; $(how_to_get_python)"
  fi
  return 1
}

how_to_get_python() {
  local distribution=""
  [ -r "$os_release" ] && distribution=$(. "$os_release" && echo "${ID:-} ${VERSION_ID:-}")
  case $distribution in
    "debian 12"*|"ubuntu 22.04"*) echo "sudo apt-get install python3.11 python3.11-venv python3.11-dev" ;;
    "ubuntu 24.04"*) echo "sudo apt-get install python3.12 python3.12-venv python3.12-dev" ;;
    "debian 13"*) echo "sudo apt-get install python3.13 python3.13-venv python3.13-dev" ;;
    *) echo "this distribution packages none of them, as far as is known: conda create -p ~/python3.11 python=3.11," \
            "then PYTHON=~/python3.11/bin/python make setup (pyenv and uv do as well)" ;;
  esac
}

free_mb() { df -Pk "$1" 2>/dev/null | awk 'NR == 2 {print int($4 / 1024)}'; }

# A full disk half way leaves a mess; what .venv holds already is about to become free.
check_disk() {
  local needed_mb=$1 held_mb=0 free
  [ -d .venv ] && held_mb=$(du -smx .venv 2>/dev/null | cut -f1)
  free=$(free_mb .)
  if [ -n "$free" ] && [ $((free + held_mb)) -lt "$needed_mb" ]; then
    say "too little disk: .venv needs about $((needed_mb / 1000)) GB, $(pwd) has $((free / 1000)).$((free % 1000 / 100)) GB" \
        "free; make room, or set up in a checkout elsewhere (TORCH_CUDA=cpu needs 3 GB)"
    return 1
  fi
  free=$(free_mb "${TMPDIR:-/tmp}")
  if [ -n "$free" ] && [ "$free" -lt $((needed_mb / 2)) ]; then
    say "too little room for pip's downloads in ${TMPDIR:-/tmp}: about $((needed_mb / 2000)) GB wanted; name a larger" \
        "folder: TMPDIR=/some/folder make setup"
    return 1
  fi
}

disk_needed_mb() { if [ "$1" = cpu ]; then echo 3000; else echo 7000; fi; }

# Whether the cards of this machine can run the build; one that was asked for by name is made anyway.
check_build() {
  local status=0
  "$python" -m drivesplat.machine.doctor.torch_builds "$1" || status=$?
  if [ "$status" = 1 ] && [ -n "${TORCH_CUDA:-}" ]; then
    say "going on, since TORCH_CUDA=$1 was asked for"
    return 0
  fi
  return "$status"
}

pip_install() {
  .venv/bin/python -m pip install --quiet "$@" && return
  say "pip failed (its message is above). No network: docs/installation.md tells how to go through a proxy or a mirror."
  exit 1
}

make_venv() {
  local build=$1
  say "installing into .venv with $("$python" --version), torch for ${build/cpu/the CPU}; a few minutes, and" \
      "$(($(disk_needed_mb "$build") / 1000)) GB at most"
  rm -f "$stamp"  # first: what an interruption leaves must not pass for whole
  rm -rf .venv
  "$python" -m venv .venv
  pip_install --upgrade pip
  if [ "$build" != cu130 ]; then
    # shellcheck disable=SC2046  (two words)
    pip_install $(grep -E '^(torch|torchvision)==' constraints.txt) --index-url "$torch_index/$build"
  fi
  pip_install -r requirements.txt -r requirements-dev.txt -c constraints.txt
  if [ "$build" != cu130 ]; then
    .venv/bin/python -c "from importlib.metadata import version as v; raise SystemExit(not v('torch').endswith('+$build'))" ||
      fail "$torch_index/$build did not give a torch for $build; is TORCH_INDEX a mirror of PyTorch's index?"
  fi
  .venv/bin/python -m pip check >&2 || fail "the installed packages do not fit together (see above)"
  pip_install --no-deps "$(grep '^nuscenes-devkit==' constraints.txt)"  # its own requirements ask for numpy < 2
  stamp_for "$build" > "$stamp"
}

# The command drivesplat, and `import drivesplat` in any folder. Whoever has no network goes without.
install_command() {
  .venv/bin/python -m pip install --quiet --no-deps -e . ||
    say "the command drivesplat could not be installed (see above); python -m drivesplat.cli does the same here"
}

# What is compiled at its first use otherwise, and waited for then: bytecode, and what trains and makes worlds on
# processors.
compile_ahead() {
  say "compiling what trains and makes synthetic worlds on processors; a minute at most"
  .venv/bin/python -m compileall -q drivesplat workflow_scripts ||
    say "no bytecode could be kept: is the checkout read-only? Every job will compile it anew"
  if .venv/bin/python -m drivesplat.training.warm_up && .venv/bin/python -m drivesplat.world.warm_up; then
    { : > "$compiled"; } 2>/dev/null || true  # a .venv of somebody else's: the next call does it again
  else
    say "all packages are in place, but a first training or world on the processors fails (see above); make doctor says more"
  fi
}

# The kernels for GPUs: by jobs on a tiny drive where there is a card; for GSPLAT_ARCHS those that can do without.
compile_for_gpus() {
  if command -v nvidia-smi >/dev/null 2>&1; then
    .venv/bin/python -m drivesplat.cli setup --gpu-kernels
  elif [ -n "${GSPLAT_ARCHS:-}" ] && [ "$GSPLAT_ARCHS" != none ]; then
    .venv/bin/python -m drivesplat.cli setup --arch "$GSPLAT_ARCHS"
  fi
}

build=${TORCH_CUDA:-$(build_made)}

if [ "${1:-}" = --check ]; then
  problems=0
  python=$(find_python) || exit 1
  check_build "$build" || problems=1
  check_disk "$(disk_needed_mb "$build")" || problems=1
  [ "$problems" = 0 ] && say "nothing stands in the way of make setup (Python: $python)"
  exit "$problems"
fi

is_made() { [ -x .venv/bin/python ] && [ "$(cat "$stamp" 2>/dev/null)" = "$(stamp_for "$build")" ]; }

# The kernel frees the lock when this process and pip end, however they end. Goes without one where there is no flock.
hold_lock() {
  local status=0
  command -v flock >/dev/null 2>&1 || return 0
  exec 9< scripts/setup.sh
  flock --nonblock --conflict-exit-code 75 9 2>/dev/null || status=$?
  [ "$status" != 75 ] || fail "another make setup is at work in $(pwd); wait until it ends"
}

is_made || hold_lock
if is_made; then
  quiet=--if-needed
else
  quiet=
  python=$(find_python) || exit 1
  check_build "$build" || exit 1
  check_disk "$(disk_needed_mb "$build")" || exit 1
  make_venv "$build"
fi
[ -x .venv/bin/drivesplat ] || install_command
no_card() { [ -z "${GSPLAT_ARCHS:-}" ] && ! command -v nvidia-smi >/dev/null 2>&1; }
if [ -z "$quiet" ] || ! no_card; then
  .venv/bin/python -m drivesplat.machine.gsplat_build $quiet ||
    fail "everything but gsplat's kernels is in place; GSPLAT_ARCHS=none make setup goes without them (CPU only)"
fi
[ -e "$compiled" ] || compile_ahead
compile_for_gpus || say "all packages are in place; the first jobs on a GPU compile its kernels, and take longer"
