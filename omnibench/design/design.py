"""Optimal experiment design: which commands to drive so that a calibration becomes most precise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from omnibench.data.dataset import Dataset
from omnibench.design.candidates import CandidatePool, read_candidates
from omnibench.design.config import Per, Use
from omnibench.design.d_optimality import ContinuousDesign, Counts, continuous_optimum, equal_design, exact_designs
from omnibench.design.result import Baseline, Design, Equivalent, Optimum, SetDesign, Step
from omnibench.design.run_information import USES, DesignProblem
from omnibench.errors import ConfigError, require_choice, require_range
from omnibench.robot.odometry import Integration
from omnibench.words import plural

# Half of each of these numbers (or of the distance from 1) and twice choose the same runs of twelve commands
# (tests/benchmarks/constants_fit.py).
# Share of the bound: the recommended design is the smallest that reaches it. The rest is worth 0.5 % of a deviation.
GOOD_EFFICIENCY = 0.99
_MOST_STEPS = 400  # runs: designs are listed up to the baseline's number, but no further than this
_MOST_RUNS = 2000  # runs or repetitions that may be asked for: more are a slip of the pen
_LEAST_SHARE = 1e-4  # a command with less of the continuous optimum is not listed: less than a run in 10,000


def design_experiment(
    source: Path | str | Dataset | CandidatePool,
    *,
    use: Use = "trajectory",
    per: Per = "run",
    runs: int | None = None,
    repetitions: int | None = None,
    dataset: str | None = None,
    integration: Integration | None = None,
) -> Design:
    """Choose the runs that shrink the covariance of the matrix elements most, from each set of candidates.

    source: a data set or its folder, a comparison config or a design config. use: the reference poses that a
    calibration uses. per: the cost that is saved: runs, s of driving, or m that the wheels roll. runs: how many to
    choose; default: the fewest within 1 % of the D-optimum. repetitions: how often a command may be chosen at most.
    dataset, integration: see ``read_candidates``. The Fisher information is taken at the design values, with wheel
    rates as exact, so that designs are optimal for matrices near them.

    OmnibenchError in one line: bad source or arguments, candidates that do not determine the whole matrix.
    """
    require_choice("use", use, get_args(Use))
    require_choice("per", per, get_args(Per))
    for name, number in (("runs", runs), ("repetitions", repetitions)):
        if number is not None:
            require_range(name, number, 1, _MOST_RUNS, whole=True)
    if isinstance(source, CandidatePool):
        pool = source
    else:
        pool = read_candidates(source, dataset=dataset, integration=integration)
    problem = DesignProblem(pool, use, per, repetitions)
    sets = tuple(_design_of_set(problem, name, runs) for name in pool.sets)
    return Design(
        source=pool.source,
        name=pool.name,
        description=pool.description,
        robot=pool.robot.name,
        simulated=pool.simulated,
        recorded=pool.recorded,
        integration=pool.integration,
        use=use,
        per=per,
        runs_asked=runs,
        most_repetitions=repetitions,
        parameters=problem.basis.shape[1],
        noise=pool.noise,
        noise_source=pool.noise_source,
        candidates=problem.described,
        baseline=Baseline(name=pool.baseline_name, precision=problem.precision(pool.baseline)),
        sets=sets,
        notes=(*pool.notes, *_remarks(pool, use, per)),
    )


def _design_of_set(problem: DesignProblem, name: str, runs: int | None) -> SetDesign:
    candidates = problem.candidates(problem.use, name)
    optimum = continuous_optimum(candidates)
    baseline = problem.pool.baseline
    most = max(min(max(int(baseline.sum()), 4 * candidates.parameters), _MOST_STEPS), runs or 0)
    designs = [
        problem.of_all(name, counts)
        for counts in exact_designs(candidates, optimum, most)
        if candidates.identifies(counts)
    ]
    steps = [problem.step(counts, optimum.bound) for counts in designs]
    chosen = _wanted(steps, runs, f"{problem.pool.source}: {name}")
    commands = [problem.described[index].name for index in problem.pool.sets[name]]
    shares = zip(commands, optimum.shares.tolist(), strict=True)
    return SetDesign(
        name=name,
        commands=tuple(commands),
        optimum=Optimum(
            shares={command: share for command, share in shares if share > _LEAST_SHARE},
            gap=optimum.gap,
            iterations=optimum.iterations,
        ),
        chosen=problem.chosen(designs[chosen]),
        step=steps[chosen],
        reached=steps[chosen].efficiency >= GOOD_EFFICIENCY,
        baseline_efficiency=problem.everything(problem.use).criterion(baseline) / optimum.bound,
        steps=tuple(steps),
        equivalents=tuple(
            _equal(problem, name, use, optimum, designs) if use == problem.use else _equal_otherwise(problem, name, use)
            for use in USES
        ),
    )


def _wanted(steps: Sequence[Step], runs: int | None, place: str) -> int:
    """Index of the recommended step: the one with ``runs``, else the first that is good enough, else the best."""
    if runs is None:
        good = [index for index, step in enumerate(steps) if step.efficiency >= GOOD_EFFICIENCY]
        if not steps:
            raise ConfigError(f"{place}: no design that the repetitions allow identifies the matrix; allow more")
        return good[0] if good else max(range(len(steps)), key=lambda index: steps[index].efficiency)
    for index, step in enumerate(steps):
        if step.effort.runs == runs:
            return index
    possible = [step.effort.runs for step in steps]
    span = f"from {possible[0]} to {possible[-1]} can" if possible else "none can"
    raise ConfigError(f"{place}: {plural(runs, 'run')} cannot be chosen so that they identify the matrix; {span}")


def _equal_otherwise(problem: DesignProblem, name: str, use: Use) -> Equivalent:
    """The equivalent for the use that the design is not made for, which may leave part of the matrix undetermined."""
    try:
        optimum = continuous_optimum(problem.candidates(use, name))
    except ConfigError:
        return Equivalent(use=use, effort=None, least=None, chosen=())
    return _equal(problem, name, use, optimum)


def _equal(
    problem: DesignProblem, name: str, use: Use, optimum: ContinuousDesign, designs: Sequence[Counts] = ()
) -> Equivalent:
    """The smallest design for a use that tells as much about the matrix as the baseline.

    designs: made already, from the smallest on; the first that tells as much is taken; if none does, one is made.
    """
    everything = problem.everything(use)
    target = everything.root(problem.pool.baseline)
    counts = next((design for design in designs if everything.root(design) >= target), None)
    if counts is None:
        in_set = equal_design(problem.candidates(use, name), optimum, target)
        counts = None if in_set is None else problem.of_all(name, in_set)
    return Equivalent(
        use=use,
        effort=None if counts is None else problem.effort(counts),
        least=target / optimum.bound,
        chosen=() if counts is None else problem.chosen(counts),
    )


def _remarks(pool: CandidatePool, use: Use, per: Per) -> tuple[str, ...]:
    """Assumptions behind the numbers."""
    logs = "as recorded" if pool.recorded else "as the design values command them"
    remarks = [
        f"Information is that of the matrix elements at the robot's design values, with wheel rates {logs} and taken "
        "as exact; the design is optimal for robots near them.",
        "It assumes that one matrix is the whole truth. To find what a matrix cannot express (slip, speed or direction "
        "dependence), drive other commands too.",
        "Exact designs are found by adding the run that gains most and by exchange, and are local optima; the bound "
        "says how far from the best they can be.",
    ]
    if per == "run":
        remarks.append("A run counts as a run however long it is; --per second or --per metre makes long ones dear.")
    if use == "final":
        remarks.append("Only the final pose of a run is used, with the same noise in m and rad, as Eq. (6) weighs it.")
    return tuple(remarks)
