#!/usr/bin/env bash
# Builds the sdist and from it the wheel, checks both, installs the wheel in a fresh environment, and runs it from an
# empty folder, where nothing of the checkout is in reach:
#   scripts/wheel_smoke.sh                          # dependencies installed afresh, by python3
#   PYTHON=python3.13 scripts/wheel_smoke.sh        # another interpreter
#   scripts/wheel_smoke.sh --reuse .venv/bin/python # dependencies borrowed from the environment of that interpreter
#   scripts/wheel_smoke.sh --out dist               # keeps the two files
# Only files that git knows are built, as they are in the work tree.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
lender=""
out=""
while [ $# -gt 0 ]; do
  case "$1 ${2:+value}" in
    "--reuse value") lender=$(command -v "$2") || { echo "no interpreter at $2"; exit 2; } ;;
    "--out value") mkdir -p "$2" && out=$(cd "$2" && pwd) ;;
    *) echo "usage: [PYTHON=python3.x] scripts/wheel_smoke.sh [--reuse PYTHON] [--out DIR]"; exit 2 ;;
  esac
  shift 2
done
unset PYTHONPATH
python=${PYTHON:-${lender:-python3}}
version='import sys; print("%d.%d" % sys.version_info[:2])'
if [ -n "$lender" ] && [ "$("$python" -c "$version")" != "$("$lender" -c "$version")" ]; then
  echo "$python and $lender are of different Python versions: compiled dependencies cannot be borrowed"
  exit 2
fi
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
step() { echo "== $*"; }

step "build with $("$python" --version)"
mkdir "$work/source" "$work/dist"
git -C "$root" ls-files -z --cached > "$work/files"
(cd "$root" && while IFS= read -r -d '' file; do [ ! -e "$file" ] || printf '%s\0' "$file"; done) \
  < "$work/files" > "$work/present"
tar -C "$root" --null -T "$work/present" -cf - | tar -C "$work/source" -xf -
"$python" -m venv "$work/tools"
"$work/tools/bin/pip" install -q build "twine>=6"
"$work/tools/bin/python" -m build --outdir "$work/dist" "$work/source" > "$work/build.log" 2>&1 \
  || { cat "$work/build.log"; exit 1; }
wheel=$(echo "$work"/dist/*.whl)
ls "$work/dist"

step "metadata and contents"
"$work/tools/bin/twine" check --strict "$work"/dist/*
"$work/tools/bin/python" - "$wheel" "$work/source" <<'PY'
import sys
import zipfile
from pathlib import Path

wheel, source = zipfile.ZipFile(sys.argv[1]), Path(sys.argv[2])
packages = sorted(p.parent.name for p in source.glob("*/__init__.py") if p.parent.name != "tests")
files = {p.relative_to(source).as_posix() for name in packages for p in (source / name).rglob("*") if p.is_file()}
held = {name for name in wheel.namelist() if ".dist-info/" not in name}
for what, names in (("left out of the wheel", files - held), ("in the wheel and not in a package", held - files)):
    if names:
        sys.exit(f"{what}: {', '.join(sorted(names))}")
print(f"{len(held)} files of {', '.join(packages)}")
PY

step "install"
"$python" -m venv "$work/venv"
if [ -n "$lender" ]; then
  "$work/venv/bin/pip" install -q --no-deps "$wheel"
  # The fresh environment's own packages come first; an editable install of this project is not taken along.
  "$lender" -c 'import sys; print("\n".join(p for p in sys.path if p.endswith("-packages")))' \
    > "$(echo "$work"/venv/lib/python3*/site-packages)/borrowed.pth"
else
  "$work/venv/bin/pip" install -q "$wheel"
  "$work/venv/bin/pip" check
fi

step "run"
mkdir "$work/elsewhere"
cd "$work/elsewhere"
bin=$work/venv/bin
"$bin/python" - "$work/venv" <<'PY'
import sys
from pathlib import Path

import datamodules
import method_configs
import visdom_plugin

for package in (visdom_plugin, method_configs, datamodules):
    at = Path(package.__file__).resolve()
    if not at.is_relative_to(Path(sys.argv[1]).resolve()):
        sys.exit(f"{package.__name__} was imported from {at}, not from the wheel")
PY
for command in "$bin"/visdom-*; do
  "$command" --help > help.txt || { echo "$(basename "$command") --help failed"; exit 1; }
  grep -q "usage: $(basename "$command")" help.txt || { echo "$(basename "$command") --help says:"; cat help.txt; exit 1; }
done
"$bin/visdom-methods" > methods.txt
for method in ingp+vd zipnerf-lite+vd zerorf-lite+vd 3dgs-go+vd corgs-lite+vd; do
  grep -qF "method:$method " methods.txt || { echo "visdom-methods does not list $method:"; cat methods.txt; exit 1; }
done
"$bin/visdom-hull" --views 4 --downscale 4 --resolution 48 --out hull.ply --json > hull.json
"$bin/python" - <<'PY'
import json
from pathlib import Path

import trimesh

hull = json.loads(Path("hull.json").read_text())
mesh = trimesh.load_mesh("hull.ply")
assert hull["voxels"] > 0 and hull["watertight"] and mesh.is_watertight, hull
print(f"hull of the built-in scene: {hull['voxels']} voxels, {len(mesh.faces)} triangles, watertight")
PY
step "short trainings on the built-in scene, opened again by the public names"
# Zip-NeRF begins empty, and draws nothing for its first hundred steps and more.
for method in zipnerf+vd visdom-gs; do
  "$bin/visdom-train" "method:$method" --method.steps 200 --downscale 4 --out "$method" > train.txt 2>&1 \
    || { cat train.txt; exit 1; }
done
"$bin/python" - <<'PY'
from importlib.metadata import version

import visdom_plugin as vd

assert not [name for name in vd.__all__ if getattr(vd, name) is None]
for method in ("zipnerf+vd", "visdom-gs"):
    run = vd.open_run(method)
    trained, again = run.metrics["psnr"], run.evaluate()["psnr"]
    assert run.record["status"] == "finished" and abs(trained - again) < 1e-3, (trained, again)
    assert (run.path / "report.html").stat().st_size > 50_000
    print(f"{method}: {trained:.2f} dB after 200 steps, and again from its checkpoint")
assert (run.path / "export" / "point_cloud.ply").exists()
print(f"all {len(vd.__all__)} public names of visdom_plugin {vd.__version__}")
print(", ".join(f"{name} {version(name)}" for name in ("torch", "numpy", "numba", "tyro")))
PY
if [ -n "$out" ]; then
  cp "$work"/dist/* "$out/"
fi
echo "== ok"
