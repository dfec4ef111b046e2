"""Poisson safety filter beside SciPy's SuperLU, PyAMG and OSQP: same grids, same commands, one process.

Three works: one robot's solve and filter (the latency of a control period), 64 robots from points to
commands (the throughput of a simulation at 5 Hz), and the quadratic program alone. The robot walks and turns
among poles; ours starts each solve from the last, the peers solve each grid afresh. Peers get their sparse
matrices ready-made, while ours makes its equations from the occupancy within its time. PyAMG is left out if
it is not installed (``pip install romnav[bench]``).
"""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import osqp
import scipy.sparse as sparse
import torch
from _common import arguments, importable, report, take_turns
from numpy.typing import NDArray
from scipy.sparse.linalg import splu, spsolve

from romnav.safety.barrier import cbf_qp, filter_velocity
from romnav.safety.filter import SafetyFilter
from romnav.safety.occupancy import Rasterizer
from romnav.safety.poisson import PoissonSolver
from romnav.safety.spec import FilterSpec, SafetySpec

CELLS = 120
CELL = 0.05
REACH = 0.367
"""Radius and margin, m."""
CLOSE = (0.01, 0.03)
"""Largest difference that agrees, of h (share of its maximum) and of the filtered velocity, m/s."""
DESIRED = (1.0, 0.1)
FILTER = FilterSpec()


class System(NamedTuple):
    """A grid's equations, as a peer wants them."""

    matrix: sparse.csc_matrix
    rhs: NDArray


def walk(frames: int, seed: int) -> tuple[NDArray, list[NDArray]]:
    """Inflated occupancy (frames, n, n) and poles (K, 2) in the frame of a robot that walks and turns."""
    rng = np.random.default_rng(seed)
    poles = rng.uniform(-6, 12, (60, 2))
    axis = (np.arange(CELLS) - (CELLS - 1) / 2) * CELL
    grids, seen = [], []
    position, yaw = np.zeros(2), 0.0
    for _ in range(frames):
        c, s = np.cos(yaw), np.sin(yaw)
        local = (poles - position) @ np.array([[c, -s], [s, c]])
        local = local[np.hypot(*local.T) > REACH + 0.1]
        square = (axis[:, None, None] - local[:, 0]) ** 2 + (axis[None, :, None] - local[:, 1]) ** 2
        grids.append((square <= REACH**2).any(2))
        seen.append(local)
        position = position + 0.2 * np.array([c, s])
        yaw += rng.uniform(-0.1, 0.1)
    return np.array(grids), seen


def system(occupied: NDArray) -> System:
    """The equations that `PoissonSolver` relaxes, both phases, in one matrix."""
    n = occupied.size
    index = np.arange(n).reshape(occupied.shape)
    diagonal = np.zeros(occupied.shape)
    rows, columns = [], []
    for here, there in (
        (np.s_[:-1], np.s_[1:]),
        (np.s_[1:], np.s_[:-1]),
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:, 1:], np.s_[:, :-1]),
    ):
        same = occupied[here] == occupied[there]
        diagonal[here] += np.where(same, 1, 2)
        rows.append(index[here][same])
        columns.append(index[there][same])
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        diagonal[edge] += 2 * ~occupied[edge]
    i, j = np.concatenate(rows), np.concatenate(columns)
    matrix = sparse.coo_matrix((-np.ones(len(i)), (i, j)), (n, n)) + sparse.diags(diagonal.ravel())
    padded = np.pad(occupied, 1, constant_values=True)
    straight = (padded[1:] != padded[:-1]).sum() + (padded[:, 1:] != padded[:, :-1]).sum()
    oblique = (padded[1:, 1:] != padded[:-1, :-1]).sum() + (padded[1:, :-1] != padded[:-1, 1:]).sum()
    forcing = CELL * np.pi / 8 * (straight + oblique / np.sqrt(2)) / (~occupied).sum()
    return System(matrix.tocsc(), np.where(occupied, -forcing, forcing).ravel())


def superlu(task: System) -> NDArray:
    return spsolve(task.matrix, task.rhs)


def superlu_symmetric(task: System) -> NDArray:
    options = {"SymmetricMode": True}
    return splu(task.matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve(task.rhs)


def amg(task: System) -> NDArray:
    import pyamg

    # As far as ours comes: one per cent of h, which takes a residual a few times smaller.
    solver = pyamg.ruge_stuben_solver(task.matrix.tocsr())
    return solver.solve(task.rhs, tol=3e-3, accel="cg")


class Osqp:
    """The velocity-box program, set up once and updated, as OSQP recommends."""

    def __init__(self) -> None:
        self.low = np.array([0.0, -FILTER.reverse, -FILTER.lateral])
        self.high = np.array([np.inf, FILTER.forward, FILTER.lateral])
        rows = sparse.csc_matrix(np.vstack([np.ones((1, 2)), np.eye(2)]))
        self.solver = osqp.OSQP()
        hessian = sparse.csc_matrix(2 * np.eye(2))
        self.solver.setup(hessian, np.zeros(2), rows, self.low, self.high, verbose=False, eps_abs=1e-6, eps_rel=1e-6)

    def solve(self, desired: NDArray, normal: NDArray, bound: float) -> NDArray:
        self.low[0] = bound
        self.solver.update(q=-2 * desired, l=self.low, Ax=np.array([normal[0], 1.0, normal[1], 1.0]))
        return self.solver.solve(raise_error=False).x

    def filter(self, h: NDArray) -> float:
        """Filter in the middle of a grid, and h there (the peers do not check the control period)."""
        a = CELLS // 2
        patch = h.reshape(CELLS, CELLS)[a - 1 : a + 1, a - 1 : a + 1]
        slope = np.array([(patch[1] - patch[0]).mean(), (patch[:, 1] - patch[:, 0]).mean()]) / CELL
        self.solve(np.array(DESIRED), slope, -FILTER.alpha * patch.mean())
        return float(patch.mean())


def peers_of_the_solve() -> dict[str, Callable[[System], NDArray]]:
    peers = {"scipy spsolve": superlu, "scipy splu, symmetric mode": superlu_symmetric}
    return peers | ({"pyamg, CG to 3e-3": amg} if importable("pyamg") else {})


def latency(repeats: int, out: Path) -> bool:
    """One robot, one frame after another."""
    grids, _ = walk(repeats + 6, 0)
    tensors = torch.from_numpy(grids)
    solver, qp = PoissonSolver(1, (CELLS, CELLS), CELL), Osqp()
    middle = torch.full((1, 2), (CELLS - 1) * CELL / 2, dtype=torch.float64)
    desired = torch.tensor([DESIRED], dtype=torch.float64)
    results = {}

    def ours(k: int) -> None:
        h = solver.solve(tensors[k : k + 1])
        results["ours"] = h, filter_velocity(h, CELL, middle, desired, FILTER)

    for k in range(6):
        ours(k)
    peers = peers_of_the_solve()
    times: dict[str, list[float]] = defaultdict(list)
    off_h = off_v = 0.0
    for k in range(6, repeats + 6):
        task = system(grids[k])
        works = {"ours": lambda k=k: ours(k)}
        works |= {f"{n} + osqp": lambda p=p, t=task: qp.filter(p(t)) for n, p in peers.items()}
        for name, seconds in take_turns(works, 1, warm_up=0).items():
            times[name] += seconds
        exact = superlu(task)
        h, filtered = results["ours"]
        free = ~grids[k].ravel()
        off_h = max(off_h, float(np.abs(h.numpy().ravel() - exact)[free].max() / exact.max()))
        check = torch.from_numpy(exact.reshape(1, CELLS, CELLS)).float()
        best = filter_velocity(check, CELL, middle, desired, FILTER)
        off_v = max(off_v, float((filtered.velocity - best.velocity).abs().max()))
    agree = off_h < CLOSE[0] and off_v < CLOSE[1]
    work = f"{CELLS} x {CELLS} Poisson solve and filter of a walking robot, one frame"
    more = {"error_of_h": off_h, "error_of_velocity_m_s": off_v}
    report("poisson", work, "s", times.pop("ours"), times, out, agree=agree, **more)
    return agree


def throughput(repeats: int, out: Path, robots: int = 64, returns: int = 220 * 59) -> bool:
    """Points to commands; the peers get the inflated grids' matrices instead, and as many threads."""
    filter_ = SafetyFilter(robots, SafetySpec(), workers=2)
    rng = np.random.default_rng(0)
    walks = [walk(repeats + 1, seed) for seed in range(robots)]
    clouds = []
    for k in range(repeats + 1):
        points = np.concatenate([rng.uniform(-5, 5, (robots, returns, 2)), np.zeros((robots, returns, 1))], 2)
        for b, (_, poles) in enumerate(walks):
            standing = np.repeat(poles[k], 40, axis=0)
            points[b, : len(standing)] = np.c_[standing, rng.uniform(0, 1.4, len(standing))]
        clouds.append(torch.from_numpy(points).float())
    desired = torch.tensor(DESIRED).expand(robots, 2)
    first = filter_(clouds[0], desired).h.numpy()
    systems = [system(grid) for grid in Rasterizer(robots)(clouds[0]).inflated.numpy()]
    programs = [Osqp() for _ in range(robots)]
    ours = [take_turns({"": lambda c=cloud: filter_(c, desired)}, 1, warm_up=0)[""][0] for cloud in clouds[1:]]
    times, off = {}, 0.0
    with ThreadPoolExecutor(2) as pool:
        for name, peer in peers_of_the_solve().items():

            def one(task: System, qp: Osqp, peer: Callable[[System], NDArray] = peer) -> float:
                return qp.filter(peer(task))

            start = time.perf_counter()
            levels = list(pool.map(one, systems, programs))
            times[f"{name} + osqp, without the points"] = [time.perf_counter() - start]
            off = max(off, float(np.abs(levels - first).max() / first.max()))
    work = f"{robots} robots, {returns} points each, to safe commands on two threads"
    more = {"error_of_h": off, "times_real_time_at_5_hz": 0.2 / statistics.median(ours)}
    agree = off < CLOSE[0]
    report("poisson-robots", work, "s", ours, times, out, agree=agree, **more)
    return agree


def programs(count: int, repeats: int, out: Path) -> bool:
    """The quadratic program alone, per program."""
    rng = np.random.default_rng(0)
    desired, angle = rng.uniform(-1, 1, (count, 2)), rng.uniform(0, 2 * np.pi, count)
    normal = np.stack([np.cos(angle), np.sin(angle)], 1)
    bound = rng.uniform(-0.5, 0.15, count)
    lower, upper = (-FILTER.reverse, -FILTER.lateral), (FILTER.forward, FILTER.lateral)
    tensors = [torch.from_numpy(x) for x in (desired, normal, bound)]
    v, feasible = (x.numpy() for x in cbf_qp(*tensors, lower, upper))
    qp, some = Osqp(), 500
    theirs = np.array([qp.solve(desired[k], normal[k], bound[k]) for k in range(some)])
    off = float(np.abs(theirs - v[:some])[feasible[:some]].max())
    works = {
        "ours": lambda: cbf_qp(*tensors, lower, upper),
        "osqp, updated and solved one by one": lambda: [qp.solve(desired[k], normal[k], bound[k]) for k in range(some)],
    }
    times = take_turns(works, repeats)
    each = {name: [t / (count if name == "ours" else some) for t in seconds] for name, seconds in times.items()}
    work = f"one CBF-QP with a velocity box, of {count} at once"
    agree = off < 1e-3
    report("poisson-qp", work, "s", each.pop("ours"), each, out, agree=agree, error_of_velocity_m_s=off)
    return agree


def main() -> None:
    """Measure, print and write ``results/bench/poisson*.json``."""
    options = arguments(__doc__, repeats=20)
    torch.set_num_threads(1)
    agree = [
        latency(options.repeats, options.out),
        throughput(max(2, options.repeats // 2), options.out),
        programs(100_000, 3, options.out),
    ]
    if not all(agree):
        raise SystemExit("ours and the peers disagree")


if __name__ == "__main__":
    main()
