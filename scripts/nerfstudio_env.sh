#!/usr/bin/env bash
# A virtual environment with nerfstudio 1.1.5, a torch for the CPU, and this project, for the tests of the adapter:
#   scripts/nerfstudio_env.sh DIR && DIR/bin/python -m pytest tests/integrations
# It works offline once installed. Two things are for such machines only and have no place in the library:
# torchvision over a CPU torch of another build lacks its operators, which nothing here calls, and fails at import
# over nms; and LPIPS starts from weights that nerfstudio would download, which here are random, so that LPIPS means
# nothing.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=${1:?name the folder of the new environment}
"${PYTHON:-python3}" -m venv "$venv"
venv=$(cd "$venv" && pwd)
"$venv/bin/pip" install -q -e "$here[nerfstudio]" "torch>=2.5,<2.14" "torchvision==0.28.0" "pytest>=7" "hypothesis>=6"
"$venv/bin/pip" check
site=$("$venv/bin/python" -c "import sysconfig; print(sysconfig.get_path('purelib'))")

cat > "$site/cpu_torchvision.py" <<'PY'
"""Defines torchvision's missing operators when torchvision is first imported; TORCH_HOME is this environment's."""
import os
import sys

os.environ.setdefault("TORCH_HOME", os.path.join(sys.prefix, "torch_home"))


class Finder:
    library = None

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name == "torchvision" and cls.library is None:
            import torch

            cls.library = torch.library.Library("torchvision", "DEF")
            for name in ("nms", "qnms"):
                cls.library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


if not os.environ.get("VISDOM_KEEP_TORCHVISION"):
    sys.meta_path.insert(0, Finder)
PY
if VISDOM_KEEP_TORCHVISION=1 "$venv/bin/python" -c "import torchvision" 2> /dev/null; then
  rm "$site/cpu_torchvision.py"
else
  echo "import cpu_torchvision" > "$site/cpu_torchvision.pth"
fi

weights="$venv/torch_home/hub/checkpoints/alexnet-owt-7be5be79.pth"
mkdir -p "$(dirname "$weights")"
"$venv/bin/python" - "$weights" <<'PY'
import sys

import torch
import torchvision

torch.manual_seed(0)
torch.save(torchvision.models.alexnet(weights=None).state_dict(), sys.argv[1])
PY
echo "ready: $venv/bin/ns-train nerfacto-vd --data DIR"
