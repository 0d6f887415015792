"""`mitsim study solver`: what the solver's precision costs in time, at the paper's geometry; no scene is in it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from matplotlib.figure import Figure

from mitsim.capture.request import Request
from mitsim.core.job import Job
from mitsim.study import plots
from mitsim.study.solver_cost import SolverRow, time_solver


@dataclass(frozen=True)
class SolverFindings:
    """Error and seconds of every form of the solution."""

    rows: tuple[SolverRow, ...]

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {"rows": [asdict(row) for row in self.rows]}

    def lines(self) -> list[str]:
        """For people, the best for its time marked at each lambda."""
        fronts = {
            lam: plots.pareto_front([(row.seconds, row.error) for row in self.rows if row.lambda_rel == lam])
            for lam in {row.lambda_rel for row in self.rows}
        }
        return [
            f"lambda {row.lambda_rel:.0e} {row.method:>4} {row.layout:<5} {row.precision:<16} {row.seconds:7.3f} s "
            f"({row.seconds:.3f} to {row.most_s:.3f}, {row.repeats} runs)  error {row.error:.1e}"
            f"{'  *' if (row.seconds, row.error) in fronts[row.lambda_rel] else ''}"
            for row in sorted(self.rows, key=lambda row: (-row.lambda_rel, row.seconds))
        ] + ["* nothing measured is as good in less time"]

    def figures(self) -> dict[str, Figure]:
        """Error against time, a panel for each lambda."""
        return {"solver.png": plots.solver_costs(self.rows)}


def measure(bench: None, request: Request, job: Job) -> SolverFindings:
    """Error and seconds of every form.

    Parameters
    ----------
    bench
        none: the solver's cost is the same for all scenes.
    request, job
        the seed of the image, and who is told how far the work is.
    """
    return SolverFindings(time_solver(request.seed, job.progress))
