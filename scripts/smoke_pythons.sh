#!/usr/bin/env bash
# Runs wheel_smoke.sh, which builds the wheel and tries it in an empty folder, with every supported Python that is here:
# those on the PATH and those of pyenv and uv. Says at the end which were there and which passed.
#   scripts/smoke_pythons.sh                # 3.10 to 3.13
#   scripts/smoke_pythons.sh 3.12 3.13      # these
set -uo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
wanted=("$@")
[ $# -gt 0 ] || mapfile -t wanted < <(sed -n 's/.*"Programming Language :: Python :: \(3\.[0-9]*\)".*/\1/p' "$root/pyproject.toml")
find_python() {
  local pyenv=${PYENV_ROOT:-$HOME/.pyenv}/versions
  for candidate in $(type -aP "python$1") "$pyenv/$1".*/bin/python "$(uv python find "$1" 2>/dev/null)"; do
    if [ "$("$candidate" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" = "$1" ]; then
      echo "$candidate"
      return
    fi
  done
}
passed=() failed=() missing=()
for version in "${wanted[@]}"; do
  python=$(find_python "$version")
  if [ -z "$python" ]; then missing+=("$version"); continue; fi
  echo "=== Python $version: $python"
  if PYTHON=$python "$root/scripts/wheel_smoke.sh"; then passed+=("$version"); else failed+=("$version"); fi
done
echo "passed: ${passed[*]:-none}; failed: ${failed[*]:-none}; not here: ${missing[*]:-none}"
[ ${#failed[@]} -eq 0 ] && [ ${#passed[@]} -gt 0 ]
