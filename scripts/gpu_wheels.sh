#!/usr/bin/env bash
# Collects what scripts/gpu_check.sh needs on a machine without a network that has torch, numba and the like:
#   scripts/gpu_wheels.sh FOLDER [SCENE]
# Wheels for Python 3.12 on x86-64 Linux go into FOLDER/wheels, and the scene, a folder in the layout of
# GaussianObject's prepared scenes (by default $VISDOM_SCENES/blowtorch), into FOLDER/scene: the photographs and masks
# of all its views, since lists count them. Compiled CUDA code may lie in FOLDER/compiled
# (scripts/gpu/build_cuda.py makes it). The whole stays below 60 MB.
set -euo pipefail
folder=${1:?name the folder to fill}
scene=${2:-${VISDOM_SCENES:-}/blowtorch}
mkdir -p "$folder/wheels"

platforms=()
for tag in manylinux_2_28 manylinux_2_27 manylinux_2_17 manylinux2014 manylinux1; do
  platforms+=(--platform "${tag}_x86_64")
done
# Their other needs are on the machine: rich, numpy, ninja, jaxtyping, typing-extensions, safetensors, pyyaml.
"${PYTHON:-python3}" -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.12 \
  --implementation cp "${platforms[@]}" --dest "$folder/wheels" \
  gsplat==1.5.3 nerfacc==0.5.3 "trimesh>=4,<6" "tyro>=0.9,!=1.0.9,!=1.0.10" docstring-parser typeguard

if [ -d "$scene" ]; then
  rm -rf "$folder/scene"
  mkdir -p "$folder/scene/images" "$folder/scene/masks"
  cp -r "$scene/sparse" "$scene/sparse_4.txt" "$scene/sparse_test.txt" "$folder/scene/"
  [ -e "$scene/SOURCE.md" ] && cp "$scene/SOURCE.md" "$folder/scene/"
  cp "$scene"/images/* "$folder/scene/images/"
  cp "$scene"/masks/* "$folder/scene/masks/"
else
  echo "no scene at $scene: parts that need one take the built-in scene" >&2
fi

size=$(du -sm "$folder" | cut -f1)
echo "$folder holds $size MB"
[ "$size" -lt 60 ] || { echo "that is more than can travel" >&2; exit 1; }
