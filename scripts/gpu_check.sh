#!/usr/bin/env bash
# What a CUDA device must show of this project, in minutes and without a network:
#   scripts/gpu_check.sh OUT [--wheels FOLDER] [--seconds 400] [--device cuda|cpu] [--tiny] [part ...]
# OUT/page.md and OUT/results.json are written anew after every single result. `scripts/gpu_wheels.sh FOLDER`
# collects what such a machine may lack; `--device cpu --tiny` is a dry run of everything. All options: --help.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
exec "${PYTHON:-python3}" -u "$here/gpu/check.py" "$@"
