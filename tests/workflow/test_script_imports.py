"""What the scripts of rules import before their work begins. Seconds of each job: torch takes one, matplotlib, pandas
and scipy some tenths."""

import json
import subprocess
import sys

import pytest
from helpers import REPOSITORY

SCRIPTS = REPOSITORY / "workflow_scripts"
NO_TORCH = {
    "ablation", "actors", "block", "blocks", "demo_world", "discover", "download_nuscenes_mini", "drive_mcap",
    "export_colmap", "export_sog", "export_spz", "extract", "film_page", "gap_report", "lidar_depth", "lidar_seed",
    "light", "lpips_backbone", "masks", "own_car", "parser", "refine_poses", "regions", "relabel", "scan_baselines",
    "scans", "scene_metrics", "tracks", "viewer_blocks",
}  # fmt: skip
"""The scripts that import no torch; export_spz does in its work."""
DRAWS = {"gap_report", "tracks"}
"""Those of them that import matplotlib, and gap_report pandas."""
LIGHT = {"ablation", "download_nuscenes_mini", "film_page", "lpips_backbone", "relabel", "scene_metrics"}
"""Those of them that import no scipy either."""
IMPORTED = """
import json, sys
source = open(sys.argv[1], encoding="utf-8").read()
exec(compile(source[: source.index("\\nwith job(")], sys.argv[1], "exec"), {"__name__": "script"})
print(json.dumps([name for name in sys.modules if "." not in name]))
"""


def imported(*command: str) -> set[str]:
    """The packages that a new process has imported at the end of a program that prints them as JSON."""
    done = subprocess.run([sys.executable, "-c", *command], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


@pytest.mark.parametrize("script", sorted(NO_TORCH))
def test_a_script_that_needs_no_torch_imports_none_and_only_what_draws_imports_matplotlib(script):
    found = imported(IMPORTED, str(SCRIPTS / f"{script}.py"))
    assert not {"torch", "gsplat", "lpips", "skimage"} & found
    assert not {"matplotlib", "pandas"} & found or script in DRAWS
    assert "scipy" not in found or script not in LIGHT


def test_the_package_itself_imports_nothing_heavy():
    found = imported("import json, sys, drivesplat; print(json.dumps([name for name in sys.modules]))")
    assert not {"torch", "numpy", "scipy", "pydantic", "yaml", "matplotlib", "cv2"} & found
