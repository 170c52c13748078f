#!/usr/bin/env bash
# Makes .venv with everything the workflow needs; leaves a good one alone.
set -euo pipefail
cd "$(dirname "$0")/.."

stamp=.venv/.made-from
wanted=$(cat requirements.txt constraints.txt | sha256sum | cut -d' ' -f1)
if [ -x .venv/bin/python ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ]; then
  exit 0
fi

usable() { "$1" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null; }

python=
for candidate in "${PYTHON:-}" python3.11 python3.12 python3 python; do
  if [ -n "$candidate" ] && command -v "$candidate" >/dev/null 2>&1 && usable "$candidate"; then
    # an activated .venv must not be what makes the new one
    python=$("$candidate" -c 'import sys; print(sys._base_executable)')
    break
  fi
done
if [ -z "$python" ]; then
  echo "setup: no Python 3.11 or 3.12 with venv found." >&2
  echo "setup: Debian 12 / Ubuntu 24.04: sudo apt-get install python3-venv; elsewhere: any Python 3.11 or 3.12 (PYTHON=/path/to/python make setup)." >&2
  exit 1
fi

echo "setup: installing into .venv with $("$python" --version); about 6 GB, a few minutes" >&2
rm -rf .venv
"$python" -m venv .venv
.venv/bin/python -m pip install --quiet --upgrade pip
.venv/bin/python -m pip install --quiet -r requirements.txt -c constraints.txt
.venv/bin/python -m pip check
echo "$wanted" > "$stamp"
