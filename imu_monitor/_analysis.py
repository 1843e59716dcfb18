"""Analysis of a recording: Allan deviations, noise coefficients, motion, noise changes and spectral lines."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from drivers.data_types import AXES
from drivers.validation.number_ranges import DURATION_S
from imu_monitor._estimates import AllanEstimate
from imu_monitor._message_wording import errors_name_arguments, replace_options_by_argument_names
from imu_monitor._recordings import Samples, check_range, to_recording, to_tau_grid
from monitor.commands.analyze import AnalysisResults, analyze_recording, save_plot_or_report
from monitor.common.unit_formatting import UnitSystem
from monitor.estimation.allan.curve import VarianceCurve
from monitor.publishing.messages.analysis_json import AnalysisMessage

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Analysis(AllanEstimate):
    """Allan deviations, noise coefficients and notes of a recording, as ``analyze`` returns them.

    The dictionary that ``to_dict`` returns also contains motion, noise changes, the bandwidth of each axis and, if
    ``window_s`` was given, the results over time.
    """

    def __init__(self, results: AnalysisResults) -> None:
        super().__init__(results.analysis.estimate)
        self._results = results

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes about the recording and the results, such as motion, spectral lines and missing samples."""
        return tuple(map(replace_options_by_argument_names, self._results.analysis.notes))

    @errors_name_arguments()
    def save_report(self, path: str | PathLike[str], title: str = "") -> None:
        """Write the analysis as an HTML page, or as a picture.

        Parameters
        ----------
        path : str or path-like
            File that ends in .html, .png, .svg or .pdf.
        title : str
            Title of the page or picture. By default, the name of the file.

        Raises
        ------
        ConfigError
            If matplotlib or Jinja2 is not installed, or if the file cannot be written.
        """
        save_plot_or_report(self._results, Path(path), title or Path(path).stem)

    def _message(self) -> AnalysisMessage:
        return self._results.to_message()

    def _total_and_hadamard(self) -> tuple[VarianceCurve | None, VarianceCurve | None]:
        return self._results.total, self._results.hadamard

    def _axes_of_temperature(self) -> tuple[str, ...]:
        return self._results.analysis.axes_of_temperature

    def _draw(self, units: UnitSystem, title: str) -> "Figure":
        from monitor.publishing.plots.allan_figure import additional_deviations
        from monitor.publishing.plots.analysis_plot import draw_analysis_figure
        from monitor.publishing.plots.dynamic_figure import ChangeMark

        found = self._results
        return draw_analysis_figure(
            found.analysis.estimate,
            found.analysis.axes_of_temperature,
            additional_deviations(found.total, found.hadamard),
            found.dynamic,
            [ChangeMark(change.since / self.rate_hz, AXES[change.axis]) for change in found.analysis.changes],
            units,
            title,
        )


@errors_name_arguments()
def analyze(
    values: Samples,
    rate_hz: float | None = None,
    *,
    axes: str | Sequence[str] | None = None,
    tau: Literal["octave", "decade10"] | Sequence[float] = "octave",
    window_s: float | None = None,
    exclude_motion: bool = False,
    total_and_hadamard: bool = False,
) -> Analysis:
    """Compute Allan deviations and noise coefficients, and detect motion, noise changes and spectral lines.

    The results are the same as those of the command ``imu-monitor analyze``.

    Parameters
    ----------
    values : Recording, mapping, pandas.DataFrame or array_like
        Samples of a sensor at rest, in rad/s and m/s². NaN means missing.

        - a recording that ``read_recording`` or ``simulate`` returned;
        - columns by name: any of ``gx gy gz ax ay az``, and optionally ``t`` in s and ``temperature`` in °C;
        - an array of shape (n, 6) in the order gx, gy, gz, ax, ay, az, or of shape (n, k) with k ``axes``, or of shape
          (n,) with one axis.
    rate_hz : float, optional
        Sample rate in Hz. Required if the samples have no times. If given, the rate takes precedence over the times.
    axes : str or sequence of str, optional
        Axis of each column of an array. By default, all six axes.
    tau : {"octave", "decade10"} or sequence of float
        Averaging times: powers of two times the sample interval, ten per decade, or a list in s.
    window_s : float, optional
        Length in s of a sliding window. If given, the result also contains Allan deviations over time.
    exclude_motion : bool
        True to exclude samples taken during motion from the Allan variance.
    total_and_hadamard : bool
        True to compute total and Hadamard deviations as well. The analysis then takes several times as long.

    Returns
    -------
    Analysis
        Mapping from the name of an axis to its deviations and coefficients.

    Raises
    ------
    ConfigError
        If an argument is wrong, or if the samples are too short for a requested averaging time or window.
    RecordingError
        If the samples or their times are not usable.
    NotReady
        If there are fewer than 50 usable samples.

    Examples
    --------
    White noise of 0.01 rad/s at 100 Hz has the angle random walk N = 0.01 / √100 rad/s/√Hz:

    >>> import imu_monitor
    >>> import numpy as np
    >>> rates = 0.01 * np.random.default_rng(1).standard_normal(60_000)
    >>> result = imu_monitor.analyze(rates, 100.0, axes="gz")
    >>> print(f"{result['gz'].coefficients['N'].value:.4f} {result['gz'].coefficients['N'].unit}")
    0.0010 rad/s/√Hz
    """
    grid = to_tau_grid(tau)
    check_range("window_s", DURATION_S, window_s)
    recording = to_recording(values, rate_hz, axes)
    return Analysis(analyze_recording(recording, grid, window_s, exclude_motion, total_and_hadamard))
