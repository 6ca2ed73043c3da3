"""Learned kinematics: a network from drive signals to twist, beside the matrix or in its place.

The matrix K is fitted first, as by ``closed_form``. A network f then corrects the twist K u of drive signals u. It is
trained through the integrated path: the twists make poses by exact arcs, and these the errors e (x, y, heading) of the
motion in a window of the run, seen from the window's start. Windows are two and eight seconds long, and whole runs:
short ones tell where the matrix fails, long ones what that adds up to. With s the root mean square (x, y, heading) of
the errors under K in all windows of a length, so that m and rad weigh alike, the loss is the mean over lengths and
their windows of

    sqrt(1 + sum over x, y, heading of (e / s)^2) - 1.                                                            (1)

(Pseudo-Huber: Charbonnier et al., IEEE Trans. Image Process. 6:298, 1997, so that no run that went wrong rules the
fit.) Training is by Adam with decoupled weight decay (Loshchilov and Hutter, arXiv:1711.05101), which here draws the
weights to those at the start, where the model is K.

Early stopping (Prechelt, in Neural Networks: Tricks of the Trade, 1998): the runs are dealt into folds, by session
where there are enough of these, else by command, else one by one. For each fold and each weight decay a network is
trained on the other runs, and the loss of the fold's runs is followed. The decay and the epoch with the least loss over
all folds are taken for the answer: the network that was trained on all runs, as it was in that epoch. The share of a
network beside the matrix that is used has the least cost, the problem's own, on the runs that were held out; without a
gain of two standard errors it is 0, and the answer is K alone. K, the scales s and the choice of epoch and decay have
seen these runs, so that the gain is a guard against networks that fit noise, and no estimate for new runs.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, NotApplicableError, PluginError
from omnibench.fit.calibrator import Calibrator, Outcome, RunResult, Solution, model_of_answer, run_calibrator
from omnibench.fit.motion_windows import MotionWindows, motions_in_windows
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.uncertainty import NoCovarianceError, uncertainty_of
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import EffectTerm, ModelExtension, covariance_rows, matrix_rows
from omnibench.robot.corrections import GROWTH, motions_of, representatives
from omnibench.robot.effects.effect import encode_weights
from omnibench.robot.effects.learned import Network
from omnibench.robot.kinematics import Array
from omnibench.robot.signals import of_centre

_LENGTHS = (2.0, 8.0, np.inf)  # s, of the windows; chosen: whole runs alone tell less, and are few
_STEP = 0.1  # s: signals are averaged over steps as long as this; chosen, motions change more slowly
_MOST_STEPS = 7_000  # of all runs together, beyond which steps are longer; chosen for the time it takes
_FOLDS = 5  # chosen: more take longer
_FEWEST = 5  # sessions, commands or runs that can be dealt into folds
_CHECK = 5  # epochs between two looks at the runs that are held out
_PATIENCE = 50  # epochs without a lower loss of these that end the training
_SHARES = np.linspace(0.0, 1.0, 5)
_SURE = 2.0  # standard errors by which a network must gain on the runs that were held out; chosen
_ROUNDING = 1e-9  # m, rad: errors as small are rounding
_ALONE = 0.1  # learning rate of a network alone, which must not lose the matrix on the way, as a share of the other's


class LearnedOptions(Options):
    """Size of the network and its training."""

    layers: tuple[int, ...] = Field((16,), min_length=1, max_length=3, description="sizes of the hidden layers")
    epochs: int = Field(120, gt=0, le=100_000, description="most passes over all runs, rounded up to fives")
    learning_rate: float = Field(0.02, gt=0, le=1, description="of Adam")
    decays: tuple[float, ...] = Field(
        (0.3, 3.0), min_length=1, max_length=8, description="weight decays of which early stopping takes one"
    )


@calibrators.register("learned")
class Learned(Calibrator):
    """The matrix of closed_form and a network that corrects its twist, trained along the path (JAX)."""

    Options = LearnedOptions
    options: LearnedOptions
    extends = True
    uses = ("fit/calibrators/closed_form.py", "jax", "optax")
    alone: ClassVar[bool] = False

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """The matrix with its network. PluginError without JAX; NotApplicableError for runs that it cannot learn from.

        The seconds that the budget allows end the training with the best network so far.
        """
        trainer = _trainer(self.name)
        units = _units(problem.trajectories)
        plain = run_calibrator(calibrators.create("closed_form"), problem)
        if plain.vector is None or plain.matrix is None:
            raise ConfigError(f"closed_form, from which it begins, gave no answer: {plain.reason}")
        if problem.best_cost <= problem.objective.rounding and not self.alone:
            return _matrix_alone(plain, "the matrix leaves no error to learn")
        if problem.seconds_left <= 0:
            return _matrix_alone(plain, "no time was left to train a network", ended=True)
        task = _Task.of(problem, plain.matrix, self.alone)
        training = _Training(task, self.options, units, problem, trainer)
        chosen = training.best()
        share = 1.0 if self.alone else _share(problem, plain.matrix, chosen.of_folds, training.folds, units)
        done = f"{training.epochs} epochs on {len(set(units))} {_kind(units, problem.trajectories)}"
        done += ", when the time was spent" if training.cut else ""
        if not share:
            return _matrix_alone(plain, f"no gain on held-out runs is sure in {done}", ended=training.cut)
        reason = (
            f"{plain.reason}; network of epoch {chosen.epoch} of {done}, weight decay {chosen.decay:g}, "
            f"held-out loss {chosen.loss:.3g} (matrix {training.of_matrix:.3g}), share {share:g}"
        )
        return Solution(
            np.array(plain.vector),
            reason,
            converged=not training.cut and plain.outcome is Outcome.CONVERGED,
            noise=plain.noise,
            extension=_extension(problem, plain, chosen.network, share),
        )


@calibrators.register("learned_alone")
class LearnedAlone(Learned):
    """A network in the place of the matrix, from which its training begins, along the path (JAX)."""

    alone = True


def _matrix_alone(plain: RunResult, why: str, *, ended: bool = False) -> Solution:
    """The answer of closed_form."""
    assert plain.vector is not None  # closed_form has answered
    converged = not ended and plain.outcome is Outcome.CONVERGED
    return Solution(np.array(plain.vector), f"{plain.reason}; the matrix alone: {why}", converged)


def _units(runs: Sequence[Trajectory]) -> list[str]:
    """The unit of each run: what is held out together. NotApplicableError: there are too few, or runs without poses."""
    bare = [run.id for run in runs if len(run.pose_times) < 2]
    if bare:
        raise NotApplicableError(f"it is trained on reference poses along the path, which run {bare[0]} has not")
    for names in ([run.session for run in runs], [run.command for run in runs], [run.id for run in runs]):
        if None not in names and len(set(names)) >= _FEWEST:
            return [str(name) for name in names]
    raise NotApplicableError(f"it holds runs out to know when to stop, for which {len(runs)} are too few; record more")


def _kind(units: Sequence[str], runs: Sequence[Trajectory]) -> str:
    """What the units of runs are, in words."""
    if list(units) == [run.session for run in runs]:
        return "sessions"
    return "commands" if list(units) == [run.command for run in runs] else "runs"


def _share(
    problem: CalibrationProblem,
    matrix: Array,
    networks: Sequence[Network],
    folds: NDArray[np.intp],
    units: Sequence[str],
) -> float:
    """The share of least cost when each fold is predicted by the network that did not see it; 0 without a sure gain."""
    costs = np.zeros((len(_SHARES), len(folds)))
    for fold, network in enumerate(networks):
        rows = np.flatnonzero(folds == fold)
        held_out = [problem.trajectories[row] for row in rows]
        for number, share in enumerate(_SHARES):
            model = model_of_answer(problem, matrix, ModelExtension(effects=(_term(network, float(share)),)))
            errors, owner = problem.objective.errors_of(model, held_out)
            costs[number, rows] = problem.objective.of_each(errors, owner)
    best = int(costs.mean(axis=1).argmin())
    gains = costs[0] - costs[best]
    names = np.array(units)
    of_units = np.array([gains[names == name].mean() for name in sorted(set(units))])
    sure = of_units.mean() > _SURE * of_units.std(ddof=1) / np.sqrt(len(of_units))
    return float(_SHARES[best]) if sure else 0.0


def _term(network: Network, share: float) -> EffectTerm:
    return EffectTerm(name="learned", parameters={"share": share}, weights=encode_weights(network.packed()))


def _extension(problem: CalibrationProblem, plain: RunResult, network: Network, share: float) -> ModelExtension:
    """The network, the motions it was trained on, and the matrix to which it fades beyond.

    The covariance of the matrix is that of its fit. The variance of the share is such that, by Eq. (3) and (4) of
    corrections.py, the network is gone at one width from the motions that it was trained on.
    """
    assert plain.matrix is not None  # there is an answer
    matrix, size = plain.matrix, plain.matrix.size
    covariance = np.zeros((size + 1, size + 1))
    with suppress(NoCovarianceError):
        covariance[:size, :size] = uncertainty_of(problem, plain).covariance
    covariance[size, size] = share**2 / GROWTH
    motions = [motions_of(matrix, run.times, run.signals) for run in problem.trajectories]
    driven = representatives(problem.robot, np.concatenate(motions))
    return ModelExtension(
        effects=(_term(network, share),),
        driven=tuple((x, y, turn) for x, y, turn in driven.tolist()),
        plain=matrix_rows(matrix),
        covariance=covariance_rows(covariance),
    )


@dataclass(frozen=True, eq=False)
class _Task:
    """Runs in steps of constant drive signals, padded to J steps, and the windows whose motion is compared.

    inputs (M, Z J): mean drive signals of the steps by their ``scales`` (M,). base (Z, J, 3): twists to which the
    network's are added. of_matrix (Z, J, 3): those of the matrix. outputs (3,): scales of the network's twist.
    to_point (3, 3): from a twist of the robot's centre to the tracked point's. durations (Z, J): s, 0 beyond a run's
    end. windows (P, 3): run, first and last edge. truth (P, 3): their motion by the reference. errors (P, 3): scales of
    Eq. (1). weights (P,): of the windows in the loss, 1 in all.
    """

    alone: bool
    inputs: Array
    scales: Array
    base: Array
    of_matrix: Array
    outputs: Array
    to_point: Array
    durations: Array
    windows: NDArray[np.intp]
    truth: Array
    errors: Array
    weights: Array

    @classmethod
    def of(cls, problem: CalibrationProblem, matrix: Array, alone: bool) -> _Task:
        """The task of a problem with a matrix (3, M)."""
        cut = MotionWindows.of(problem.trajectories, _LENGTHS, _STEP, _MOST_STEPS)
        drive, durations, lengths = cut.drive, cut.durations, cut.lengths
        twists, count = drive @ matrix.T, len(np.unique(lengths))
        moved = motions_in_windows(twists, durations, cut.windows) - cut.motions
        errors, weights = np.zeros_like(moved), np.zeros(len(moved))
        for number in np.unique(lengths):
            of_length = lengths == number
            errors[of_length] = np.maximum(np.sqrt(np.square(moved[of_length]).mean(axis=0)), _ROUNDING)
            weights[of_length] = 1 / (of_length.sum() * count)
        shortest = lengths == lengths.min()
        seconds = np.mean([durations[run, low:high].sum() for run, low, high in cut.windows[shortest]])
        outputs = errors[shortest][0] / seconds
        busy = durations > 0
        if alone:
            outputs = np.maximum(np.sqrt(np.square(of_centre(problem.robot, twists[busy])).mean(axis=0)), outputs)
        scales = np.quantile(np.abs(drive[busy]), 0.99, axis=0)
        scales = np.where(scales > _ROUNDING, scales, 1.0)
        mount = problem.robot.mount
        return cls(
            alone=alone,
            inputs=np.ascontiguousarray((drive / scales).reshape(-1, len(scales)).T),
            scales=scales,
            base=np.zeros_like(twists) if alone else twists,
            of_matrix=twists,
            outputs=outputs,
            to_point=np.eye(3) if mount is None else mount.twist,
            durations=durations,
            windows=cut.windows,
            truth=cut.motions,
            errors=errors,
            weights=weights,
        )

    def start(self, sizes: Sequence[int], rng: np.random.Generator) -> list[Array]:
        """Random hidden weights, and last ones with which the network is the matrix: W_1, b_1, ..., last."""
        parts, active = list[Array](), self.inputs
        for size in sizes:
            parts += [rng.normal(size=(size, len(active))) / np.sqrt(len(active)), rng.normal(0, 0.5, size)]
            active = np.tanh(parts[-2] @ active + parts[-1][:, None]) - np.tanh(parts[-1])[:, None]
        if not self.alone:
            return [*parts, np.zeros((3, len(active)))]
        target = self.of_matrix.reshape(-1, 3) @ np.linalg.inv(self.to_point).T / self.outputs
        ridge = 1e-6 * active.shape[1] * np.eye(len(active))
        return [*parts, np.linalg.solve(active @ active.T + ridge, active @ target).T]

    @functools.cached_property
    def data(self) -> dict[str, Array]:
        """What ``_losses`` needs."""
        names = ("inputs", "outputs", "to_point", "base", "durations", "windows", "truth", "errors")
        return {name: getattr(self, name) for name in names}

    def losses_of_matrix(self) -> Array:
        """Eq. (1) of every window (P,) under the matrix."""
        errors = motions_in_windows(self.of_matrix, self.durations, self.windows) - self.truth
        losses: Array = np.sqrt(1 + np.square(errors / self.errors).sum(axis=-1)) - 1
        return losses

    def network(self, parts: Sequence[Array]) -> Network:
        """The network of weights as in ``start``."""
        layers = tuple(zip(parts[:-1:2], parts[1:-1:2], strict=True))
        return Network(self.alone, self.scales, self.outputs, layers, parts[-1])


def _losses(parts: Any, data: Any, math: Any = np) -> Any:
    """Eq. (1) of every window (P,) with a network of weights as in ``_Task.start``; data: ``_Task.data``."""
    active = data["inputs"]
    for weights, biases in zip(parts[:-1:2], parts[1:-1:2], strict=True):
        active = math.tanh(weights @ active + biases[:, None]) - math.tanh(biases)[:, None]
    added = ((data["to_point"] * data["outputs"]) @ (parts[-1] @ active)).T
    twists = data["base"] + added.reshape(data["base"].shape)
    errors = motions_in_windows(twists, data["durations"], data["windows"], math) - data["truth"]
    return math.sqrt(1 + math.square(errors / data["errors"]).sum(axis=-1)) - 1


@functools.cache
def _trainer(name: str) -> Any:
    """A function that trains several networks for a few epochs, compiled once. PluginError: there is no JAX."""
    try:
        import jax
        import optax
    except ImportError:
        raise PluginError(f'calibrator {name!r} needs JAX and optax; pip install "omnibench[learned]"') from None
    adam = optax.scale_by_adam()

    def epoch(parts: Any, state: Any, begun: Any, weights: Any, decay: Any, rate: Any, data: Any) -> Any:
        slopes = jax.grad(lambda parts: (_losses(parts, data, jax.numpy) * weights).sum())(parts)
        steps, state = adam.update(slopes, state)
        return jax.tree.map(lambda p, s, b: p - rate * (s + decay * (p - b)), parts, steps, begun), state

    def train(parts: Any, state: Any, *given: Any) -> Any:
        every = jax.vmap(epoch, in_axes=(0, 0, None, 0, 0, None, None))
        now, _ = jax.lax.scan(lambda now, _: (every(*now, *given), None), (parts, state), None, length=_CHECK)
        return *now, jax.vmap(lambda parts: _losses(parts, given[-1], jax.numpy))(now[0])

    compiled = jax.jit(train)

    def in_double_precision(parts: Any, state: Any, *given: Any) -> Any:
        """Weights and state of Adam after some epochs, and losses (networks, P)."""
        with jax.enable_x64(True):
            return compiled(parts, jax.vmap(adam.init)(parts) if state is None else state, *given)

    return in_double_precision


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Networks of one epoch and decay: of all runs, and of those without each fold; their loss on held-out runs."""

    network: Network
    of_folds: list[Network]
    epoch: int
    decay: float
    loss: float


class _Training:
    """Networks for every fold and decay, and for all runs, side by side.

    folds (Z,): of each run. epochs: that were trained. cut: True if the time ended it. of_matrix: loss of the matrix.
    """

    def __init__(
        self, task: _Task, options: LearnedOptions, units: Sequence[str], problem: CalibrationProblem, trainer: Any
    ) -> None:
        self._task, self._options = task, options
        names = sorted(set(units))
        place = dict(zip(names, problem.rng.permutation(len(names)).tolist(), strict=True))
        self.folds = np.array([place[unit] % _FOLDS for unit in units])
        self._of_windows = self.folds[task.windows[:, 0]]
        self.of_matrix = float(task.weights @ task.losses_of_matrix())
        begun = task.start(options.layers, problem.rng)
        at_start = float(task.weights @ _losses(begun, task.data))
        networks, decays = (_FOLDS + 1) * len(options.decays), np.array(options.decays)
        self.epochs, self.cut = 0, False
        self._kept = [[np.repeat(part[None], networks, axis=0) for part in begun]]
        self._held_out = [np.full(len(decays), at_start)]
        seen = np.array([*(self._of_windows != fold for fold in range(_FOLDS)), np.ones(len(task.weights))])
        weights = seen * task.weights
        weights = np.repeat(weights / weights.sum(axis=1, keepdims=True), len(decays), axis=0)
        rate = options.learning_rate * (_ALONE if task.alone else 1.0)
        given = (begun, weights, np.tile(decays, _FOLDS + 1), rate, task.data)
        parts, state = self._kept[0], None
        while self.epochs < options.epochs and self.epochs <= self._best_epoch + _PATIENCE and not self.cut:
            parts, state, losses = trainer(parts, state, *given)
            self.epochs += _CHECK
            self._kept.append([np.asarray(part) for part in parts])
            self._held_out.append(self._of_held_out(np.asarray(losses)))
            problem.report(self.epochs, options.epochs, "epoch", float(np.min(self._held_out)))
            self.cut = problem.seconds_left <= 0

    def best(self) -> _Chosen:
        """The networks of the epoch and decay with the least loss on the runs that were held out."""
        check, decay = np.unravel_index(int(np.argmin(self._held_out)), np.shape(self._held_out))
        of_all = [
            self._task.network([part[fold * len(self._options.decays) + decay] for part in self._kept[check]])
            for fold in range(_FOLDS + 1)
        ]
        loss = float(self._held_out[check][decay])
        return _Chosen(of_all[-1], of_all[:-1], int(check) * _CHECK, self._options.decays[decay], loss)

    @property
    def _best_epoch(self) -> int:
        return _CHECK * int(np.min(self._held_out, axis=1).argmin())

    def _of_held_out(self, losses: Array) -> Array:
        """Loss (decays,) of the runs that were held out, from those of every network and window."""
        of_folds = losses.reshape(_FOLDS + 1, len(self._options.decays), -1)
        held_out = self._of_windows == np.arange(_FOLDS)[:, None]
        total: Array = np.einsum("fdp,fp,p->d", of_folds[:-1], held_out.astype(float), self._task.weights)
        return total
