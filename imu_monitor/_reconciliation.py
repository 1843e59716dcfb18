"""Comparison of a recording with a noise model, and search for the effects that the model lacks."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec

from drivers.errors import ConfigError
from drivers.host.extras import require_extra
from drivers.validation.number_ranges import SEED
from imu_monitor._display import build_dataframe, render_html, render_text
from imu_monitor._message_wording import errors_name_arguments, replace_options_by_argument_names
from imu_monitor._models import ModelSource, to_model
from imu_monitor._recordings import Samples, check_range, to_recording
from monitor.common.unit_formatting import format_duration
from monitor.noise.model import NoiseModel

if TYPE_CHECKING:
    import pandas as pd

    from monitor.reconcile.result import Reconciliation as Result

FIGURE_CAPTION: Final = (
    "Allan plots of the axes that differ, and 95 % band of the model after the search. The orange numbers are the rows "
    "of the\nfindings. They mark the averaging times at which a finding changes the Allan deviation most."
)
FIGURE_WIDTH_EM: Final = 40.0


class Reconciliation:
    """Result of the comparison of a recording with a noise model, as ``reconcile`` returns it."""

    def __init__(self, result: "Result") -> None:
        self._result = result

    @property
    def verdict(self) -> Literal["agrees", "explained", "partly_explained", "unexplained"]:
        """Decision whether the recording agrees with the model and, if not, whether known effects explain why."""
        return self._result.verdict

    @property
    def summary(self) -> tuple[str, ...]:
        """At most five sentences that describe the result."""
        from monitor.reconcile.summary.summary_sentences import summarize

        return tuple(summarize(self._result))

    @property
    def tested_model(self) -> NoiseModel:
        """Noise model that was compared with the recording."""
        return self._result.baseline

    @property
    def model(self) -> NoiseModel:
        """Noise model with the effects that were found."""
        return self._result.model

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that were compared."""
        return tuple(self._result.axes)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes about the recording."""
        return tuple(map(replace_options_by_argument_names, self._result.notes))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``report.json`` as plain Python objects (docs/explanation/reconcile.md)."""
        from monitor.reconcile.json_report import encode_report

        result: dict[str, Any] = msgspec.json.decode(encode_report(self._result))
        return result

    def to_dataframe(self) -> "pd.DataFrame":
        """Return the findings as a pandas DataFrame, sorted by the share of the gap that they explain, largest first.

        Raises
        ------
        ConfigError
            If pandas is not installed.
        """
        findings = self.to_dict()["findings"]
        names = ("effect", "kind", "axes", "share", "confidence", "gain_nats", "parameters")
        return build_dataframe({name: [finding[name] for finding in findings] for name in names})

    @errors_name_arguments()
    def save_report(self, folder: str | PathLike[str], title: str = "recording") -> None:
        """Write ``report.html``, ``report.json``, ``model.toml`` and, if Rerun is installed, ``reconcile.rrd``.

        Parameters
        ----------
        folder : str or path-like
            Folder of the report, which is created if it does not exist.
        title : str
            Title of the HTML page.

        Raises
        ------
        ConfigError
            If matplotlib or Jinja2 is not installed, or if the folder cannot be written.
        """
        from monitor.commands.reconcile import create_report_folder, write_report

        create_report_folder(Path(folder))
        write_report(self._result, Path(folder), title)

    def __repr__(self) -> str:
        found = self._result
        duration = format_duration(found.duration_s)
        return f"<Reconciliation of {' '.join(self.axes)}: {self.verdict}, {found.samples} samples, {duration}>"

    def __str__(self) -> str:
        from monitor.publishing.terminal.reconcile_text import print_reconciliation

        return replace_options_by_argument_names(
            render_text(lambda console: print_reconciliation(self._result, console, details=True))
        )

    def _repr_html_(self) -> str:
        """Return the text, and the Allan plot of each axis that differs if matplotlib is installed."""
        from monitor.publishing.reports.reconcile_page import draw_differing_allan_deviations
        from monitor.reconcile.summary.ranked_findings import rank_findings

        try:
            figures = draw_differing_allan_deviations(self._result, rank_findings(self._result))
        except ConfigError:
            figures = []
        return render_html(f"{self}\n\n{FIGURE_CAPTION}" if figures else str(self), figures, FIGURE_WIDTH_EM)


@errors_name_arguments()
def reconcile(
    values: Samples,
    model: ModelSource | None = None,
    rate_hz: float | None = None,
    *,
    axes: str | Sequence[str] | None = None,
    seed: int = 1,
) -> Reconciliation:
    """Compare samples with a noise model, and find the effects that the model lacks.

    The result is the same as that of the command ``imu-monitor reconcile``. The comparison takes seconds to minutes,
    and needs SciPy.

    Parameters
    ----------
    values : Recording, mapping, pandas.DataFrame or array_like
        Samples of a sensor at rest, in one of the forms that ``analyze`` accepts.
    model : NoiseModel, str or path-like, optional
        Noise model, name of a shipped model, or path of a model file. By default, the five noise terms Q, N, B, K and R
        are fitted to the samples.
    rate_hz : float, optional
        Sample rate in Hz. Required if the samples have no times.
    axes : str or sequence of str, optional
        Axis of each column of an array. By default, all six axes.
    seed : int
        Seed of the random numbers. The same seed gives the same result.

    Returns
    -------
    Reconciliation
        Decision, summary, and the model with the effects that were found.

    Raises
    ------
    ConfigError
        If an argument is wrong, or if SciPy is not installed.
    RecordingError
        If the samples or their times are not usable.
    NotReady
        If there are fewer than 4096 samples, or if no axis can be compared.

    Examples
    --------
    >>> import imu_monitor
    >>> from imu_monitor.effects import AngleRandomWalk, Sinusoidal
    >>> noise = imu_monitor.NoiseModel({"gz": (AngleRandomWalk(N=1e-4),)})
    >>> line = imu_monitor.NoiseModel({"gz": (Sinusoidal(amplitude=1e-3, frequency=17.0),)})
    >>> recording = imu_monitor.simulate(noise + line, duration_s=100.0, rate_hz=100.0)
    >>> result = imu_monitor.reconcile(recording, noise)
    >>> result.verdict
    'explained'
    >>> [effect.name for _, effect in result.model]
    ['angle_random_walk', 'sinusoidal']
    """
    require_extra("reconcile", "reconcile")
    from monitor.commands.reconcile import reconcile_recording

    check_range("seed", SEED, seed)
    tested = None if model is None else to_model(model)[0]
    return Reconciliation(reconcile_recording(to_recording(values, rate_hz, axes), tested, seed))
