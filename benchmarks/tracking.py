"""Errors of a run's trajectory beside those of the program evo, which is no dependency.

    python -m venv EVO && EVO/bin/pip install evo
    python benchmarks/tracking.py RUN --evo EVO/bin/python

RUN is a run of `lumigraph track` whose recording has poses. Written: ATE and RPE of both programs, and the largest
difference between them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path

from lumigraph.evaluation.tracking import Tracked
from lumigraph.run import Run

EVO = """
import json, sys
from evo.core import metrics, sync
from evo.tools import file_interface
truth, found = (file_interface.read_tum_trajectory_file(path) for path in sys.argv[1:])
truth, found = sync.associate_trajectories(truth, found)
result = {}
aligned = __import__("copy").deepcopy(found)
aligned.align(truth, correct_scale=False)
ape = metrics.APE(metrics.PoseRelation.translation_part)
ape.process_data((truth, aligned))
result["ate"] = ape.get_statistic(metrics.StatisticsType.rmse)
for name, relation in (("rpe", "translation_part"), ("rpe_degrees", "rotation_angle_deg")):
    rpe = metrics.RPE(metrics.PoseRelation[relation], 1, metrics.Unit.frames, all_pairs=False)
    rpe.process_data((truth, found))
    result[name] = rpe.get_statistic(metrics.StatisticsType.rmse)
print(json.dumps(result))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--evo", type=Path, help="a Python that has evo")
    given = parser.parse_args()
    run = Run(given.run)
    errors = Tracked.of(run.method(), run.scene()).errors
    assert errors is not None, "the recording has no poses"
    own = {name: getattr(errors, name) for name in ("ate", "rpe", "rpe_degrees")}
    print("lumigraph", own)
    if given.evo is None:
        return
    files = [str(given.run / name) for name in ("truth.txt", "trajectory.txt")]
    done = subprocess.run([str(given.evo), "-c", EVO, *files], capture_output=True, text=True, check=True)
    other = json.loads(done.stdout.splitlines()[-1])
    print("evo      ", other)
    print("largest difference", max(abs(own[name] - other[name]) for name in own))


if __name__ == "__main__":
    main()
