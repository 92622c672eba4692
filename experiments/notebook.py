"""What notebooks ask of the experiments: rows of sweeps as tables and statistics, the thesis's figures, and pictures."""

from experiments import _figures as figures
from experiments import _look as look
from experiments import _plots as plots
from experiments import _report as report
from experiments import _statistics as statistics
from experiments import _study as study
from experiments._rows import read_latest

__all__ = ["figures", "look", "plots", "read_latest", "report", "statistics", "study"]
