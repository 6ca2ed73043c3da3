"""Maximum a posteriori: the most probable matrix and lost wheel rate, by all references and the robot's design.

What it minimises stands in fit/estimate.py, what is known of a design in fit/prior.py, and its intervals in
fit/intervals.py. Beside the matrix stands one effect that all robots here have in common, the rate that every turning
wheel loses or gains (``wheel_dead_zone``): rollers creep, tyres slip in turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import NonNegative, Positive
from omnibench.data.dataset import Trajectory
from omnibench.data.stored import drawn_runs
from omnibench.errors import DataError
from omnibench.fit import estimate as estimates
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.intervals import Clusters, jackknife
from omnibench.fit.loss import loss_of
from omnibench.fit.motion_windows import windows_of
from omnibench.fit.prior import default_mount, physical_prior_root, physical_tolerance
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import EffectTerm, ModelExtension, covariance_rows, matrix_rows

# Wheel samples of the runs that are looked at, 3 hours at 100 Hz: more runs say no more of a robot than slip lets them,
# and take minutes; chosen.
_MOST_SAMPLES = 1_000_000
# s: parts of a single long run, as recordings of one drive are cut on import. Of two runs of OptiOdom robots cut like
# that the error on others is up to twice as large as of the whole ones.
_WINDOW = 12.0
_MOST_STEPS = 40  # steps that the progress of an estimate counts to
_FORMER = ("start", "weights", "covariance", "tolerance")  # options of trajectory_ml


def runs_of_estimate(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """The runs that an estimate is of: of very many some; of a single one, which says not how runs scatter, windows."""
    runs = drawn_runs(trajectories, _MOST_SAMPLES)
    single = len(runs) == 1 and runs[0].has_poses
    return list(windows_of(runs[0], max(int(runs[0].end / _WINDOW), 1))) if single else list(runs)


class MapOptions(Options):
    """Options: what is estimated beside the matrix."""

    lost_rate: NonNegative | None = Field(
        None,
        description="standard deviation of the rate that turning wheels lose, rad/s; 0: none; default: the class's",
    )
    start_heading: NonNegative = Field(
        estimates.USUAL_NUISANCES[0],
        description="standard deviation of the runs' start headings, rad; 0: they are exact",
    )
    clock: Literal["none", "offset", "offset_and_slope"] = Field(
        "offset", description="of the reference, estimated for each run; none: it is exact"
    )
    clock_offset: Positive = Field(estimates.USUAL_NUISANCES[1], description="its expected size, s")
    clock_slope: Positive = Field(0.003, description="its expected size, s per s")
    steering: Literal["known", "fit"] = Field("known", description="fit: also its gain, play and coupling, or zero")

    @model_validator(mode="before")
    @classmethod
    def _without_former_options(cls, content: Any) -> Any:
        """Take options of trajectory_ml: an exact start has no deviation, and the others have no use any more."""
        if not isinstance(content, dict):
            return content
        exact = {"start_heading": 0.0} if content.get("start") == "exact" else {}
        return exact | {name: value for name, value in content.items() if name not in _FORMER}


@calibrators.register("map", former=("posterior", "trajectory_ml"))
class Map(Calibrator):
    """Most probable wheels, track and lost wheel rate, given all references and the design (maximum a posteriori)."""

    Options = MapOptions
    options: MapOptions
    bounded = False  # its prior takes the place of the box
    weighs_design = True
    extends = True
    stochastic = False

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Gauss-Newton steps to the minimum. DataError: no run has a reference after its start."""
        self.needs_matrix(problem)
        robot, options = problem.robot, self.options
        tolerance, mount = physical_tolerance(robot), problem.mount
        if problem.tolerance is not None:  # only the elements are off their design then
            mount = mount or default_mount(robot)
            tolerance = replace(tolerance, radius=0.0, rows=(0.0, 0.0, 0.0), elements=problem.tolerance)
        runs = runs_of_estimate(problem.trajectories)
        lost = tolerance.lost_rate if options.lost_rate is None else options.lost_rate
        clock = (options.clock_offset * (options.clock != "none"), options.clock_slope * options.clock.count("slope"))
        loss = loss_of(problem.objective)

        of_runs = estimates.EstimateProblem(
            robot,
            runs,
            problem.parameterisation.projection @ physical_prior_root(robot, tolerance, mount),
            problem.integration,
            problem.sample_period,
            (estimates.Unknown(*estimates.LOST_RATE, lost),) if lost else (),
            estimates.Nuisances(options.start_heading, *clock),
            "huber" if loss == "squares" else loss,
        )

        def may_go_on(steps: int) -> bool:
            problem.report(steps, _MOST_STEPS, "step")
            return problem.seconds_left > 0

        if options.steering == "fit":
            found = estimates.estimate_with_steering(of_runs, may_go_on)
        else:
            found = estimates.estimate(of_runs, may_go_on)
        clusters = Clusters.of(runs)
        unit = np.eye(found.root.shape[1])
        covariance = jackknife(found.information, found.scores, clusters, unit, found.root)
        end = f"{'' if found.at_rest else 'not '}at rest after {found.steps} steps"
        extension, size = None, found.matrix.size
        if found.terms:
            extension = ModelExtension(
                effects=tuple(map(EffectTerm.of, found.terms)),
                covariance=covariance_rows(covariance.matrix),
                plain=matrix_rows(estimates.estimate(replace(of_runs, unknowns=()), may_go_on, found).matrix),
            )
        if len(runs) < len(problem.trajectories):
            end += f" with {len(runs):,} of {len(problem.trajectories):,} runs, which chance has drawn"
        if lost:
            rate = float(found.terms[0].values[estimates.LOST_RATE[1]])
            end += f"; turning wheels {'gain' if rate > 0 else 'lose'} {abs(rate):.4f} rad/s"
        if not np.isfinite(problem.cost(found.matrix.reshape(1, -1))).all():
            raise DataError("the cost of its answer is not finite")
        freedom = np.broadcast_to(covariance.degrees_of_freedom, len(found.root))[:size]
        return Solution(
            found.matrix.ravel(),
            end,
            converged=found.at_rest,
            covariance=covariance.matrix[:size, :size],
            degrees_of_freedom=np.array(freedom),
            extension=extension,
            covariance_source=clusters.words,
        )
