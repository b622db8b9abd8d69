"""Compiles the CUDA code of gsplat or nerfacc into one file, beside which their Python runs without a compiler.

    TORCH_CUDA_ARCH_LIST=9.0 python scripts/gpu/build_cuda.py gsplat FOLDER

writes FOLDER/gsplat_csrc.so. It needs nvcc, ninja and the torch that will load the file, but no GPU. Both packages
look for a module `csrc` of their own before they compile anything; `install` puts the file there.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

PACKAGES = ("gsplat", "nerfacc")


def home(package: str) -> Path:
    """The folder of an installed package, found without importing it."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise SystemExit(f"{package} is not installed")
    return Path(next(iter(spec.submodule_search_locations)))


def built_name(package: str) -> str:
    """Name of the compiled file in a cache folder."""
    return f"{package}_csrc.so"


def install(package: str, cache: Path) -> bool:
    """Puts the compiled file from a cache folder into the installed package; False where there is none."""
    source = cache / built_name(package)
    if not source.is_file():
        return False
    target = home(package) / "csrc.so"
    part = target.with_suffix(".part")
    shutil.copyfile(source, part)
    part.replace(target)
    return True


def build(package: str, cache: Path) -> float:
    """Compiles, and leaves the file in the cache folder; returns the seconds it took."""
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", "9.0")
    os.environ.setdefault("MAX_JOBS", str(os.cpu_count() or 2))
    from torch.utils.cpp_extension import load

    code = home(package) / "cuda"
    sources = sorted([*code.glob("csrc/*.cu"), *code.glob("csrc/*.cpp"), *code.glob("ext.cpp")])
    includes = [code / "include", code / "csrc" / "third_party" / "glm"]
    # Where the toolkit is nvcc alone, the other headers come with torch's own packages, laid beside it.
    includes += [Path(folder) / "nvidia" / "cu13" / "include" for folder in sys.path]
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=f"build-{package}-") as folder:
        load(
            "csrc",
            [str(s) for s in sources],
            extra_cflags=["-O3", "-Wno-attributes"],
            # gsplat's own switch; nerfacc is compiled without it.
            extra_cuda_cflags=["-O3", *(["-use_fast_math"] if package == "gsplat" else [])],
            extra_include_paths=[str(i) for i in includes if i.is_dir()],
            build_directory=folder,
            verbose=True,
        )
        cache.mkdir(parents=True, exist_ok=True)
        part = cache / (built_name(package) + ".part")
        shutil.copyfile(Path(folder) / "csrc.so", part)
        part.replace(cache / built_name(package))
    return time.monotonic() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("package", choices=PACKAGES)
    parser.add_argument("cache", type=Path)
    args = parser.parse_args()
    seconds = build(args.package, args.cache)
    size = (args.cache / built_name(args.package)).stat().st_size
    print(f"{args.package} compiled in {seconds:.0f} s, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    sys.exit(main())
