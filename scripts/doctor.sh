#!/usr/bin/env bash
# What works on this machine and what does not; without .venv, what stands between here and one.
set -euo pipefail
cd "$(dirname "$0")/.."
export PATH=$PATH:/usr/lib/wsl/lib  # where Windows' Linux keeps nvidia-smi
if [ -x .venv/bin/python ] && [ -f .venv/.made-from ]; then
  exec .venv/bin/python -m drivesplat.machine.doctor "$@"
fi
echo "fix   .venv          there is none, or a half-made one: run make setup (or, with a Python of your own that has" \
     "everything, python -m drivesplat.machine.doctor)"
bash scripts/setup.sh --check || true
exit 1
