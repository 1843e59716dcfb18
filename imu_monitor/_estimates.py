"""Allan deviations and noise coefficients of the axes of an IMU, and their plot."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from imu_monitor._display import build_dataframe, render_html, render_text
from monitor.common.unit_formatting import (
    COEFFICIENT_NAMES,
    DEFAULT_UNITS,
    NO_VALUE,
    UNIT_SYSTEMS,
    UnitSystem,
    coefficient_unit,
    format_duration,
    format_number,
    sensor_kind,
)
from monitor.estimation.allan.curve import AllanCurve, VarianceCurve
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.publishing.messages.analysis_json import AnalysisMessage, AxisAnalysis, AxisDeviations
from monitor.publishing.messages.results import coefficient_values, deviations_with_interval_ends, measured_axes

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SI_UNITS: Final = UNIT_SYSTEMS["si"]


@dataclass(frozen=True, slots=True, repr=False)
class Coefficient:
    """Noise coefficient of one axis, with its 95 % interval, in SI units.

    Attributes
    ----------
    symbol : {"Q", "N", "B", "K", "R"}
        Symbol of the coefficient in IEEE Std 952.
    axis : str
        Name of the axis.
    value : float
        Estimate. NaN unless ``status`` is "estimated".
    lo, hi : float
        Ends of the 95 % interval. For an upper bound, ``hi`` is the one-sided 95 % bound.
    status : {"estimated", "upper_bound", "unestimated"}
        "unestimated" means that there are too few data.
    """

    symbol: str
    axis: str
    value: float
    lo: float
    hi: float
    status: str

    @property
    def name(self) -> str:
        """Name of the coefficient, such as "angle random walk"."""
        return COEFFICIENT_NAMES[sensor_kind(self.axis)][self.symbol]

    @property
    def unit(self) -> str:
        """SI unit of ``value``, ``lo`` and ``hi``, such as "rad/s/√Hz"."""
        return SI_UNITS.coefficients[sensor_kind(self.axis)][self.symbol].name

    def __repr__(self) -> str:
        unit = coefficient_unit(self.symbol, self.axis)
        value, lo, hi = (format_number(number * unit.factor) for number in (self.value, self.lo, self.hi))
        text = {"estimated": f"{value} [{lo} … {hi}] {unit.name}", "upper_bound": f"≤ {hi} {unit.name}"}
        return f"<{self.symbol} of {self.axis}: {text.get(self.status, NO_VALUE)}>"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Deviations:
    """Allan, total or Hadamard deviations of one axis, with 95 % intervals.

    Attributes
    ----------
    tau_s : ndarray of float64, shape (m,)
        Averaging times in s.
    deviation : ndarray of float64, shape (m,)
        Deviations in rad/s or m/s². NaN if unknown.
    lo, hi : ndarray of float64, shape (m,)
        Ends of the 95 % intervals in rad/s or m/s².
    """

    tau_s: Floats
    deviation: Floats
    lo: Floats
    hi: Floats

    def __repr__(self) -> str:
        return f"<Deviations at {len(self.tau_s)} averaging times from {self.tau_s[0]:g} s to {self.tau_s[-1]:g} s>"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class AxisEstimate:
    """Allan deviations and noise coefficients of one axis.

    Attributes
    ----------
    axis : str
        Name of the axis.
    allan : Deviations
        Overlapping Allan deviations.
    fitted : ndarray of float64, shape (m,)
        Allan deviations of the fitted model at the averaging times of ``allan``, in rad/s or m/s². NaN if an averaging
        time is not used in the fit.
    coefficients : mapping of str to Coefficient
        Noise coefficients Q, N, B, K and R.
    total, hadamard : Deviations or None
        Total and Hadamard deviations, if they have been computed.
    """

    axis: str
    allan: Deviations
    fitted: Floats
    coefficients: Mapping[str, Coefficient]
    total: Deviations | None = None
    hadamard: Deviations | None = None

    def __repr__(self) -> str:
        return f"<AxisEstimate of {self.axis}: {', '.join(map(repr, self.coefficients.values()))}>"


class AllanEstimate(Mapping[str, AxisEstimate]):
    """Allan deviations and noise coefficients of all measured axes.

    An estimate is a mapping from the name of an axis to an ``AxisEstimate``. ``AllanWindow.estimate`` returns an
    estimate, and ``analyze`` returns an estimate with notes and events.

    Examples
    --------
    >>> import imu_monitor
    >>> estimate = imu_monitor.analyze(imu_monitor.simulate("mti-1", duration_s=600.0))
    >>> list(estimate)
    ['gx', 'gy', 'gz', 'ax', 'ay', 'az']
    >>> estimate["gz"].coefficients["N"].status
    'estimated'
    """

    def __init__(self, estimate: Estimate) -> None:
        self._estimate = estimate

    @property
    def rate_hz(self) -> float:
        """Sample rate in Hz."""
        return self._estimate.rate_hz

    @property
    def duration_s(self) -> float:
        """Duration of the samples in s, including missing samples."""
        return self._estimate.curve.n / self.rate_hz

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes about the recording and the results."""
        return ()

    def __getitem__(self, axis: str) -> AxisEstimate:
        return self._axes[axis]

    def __iter__(self) -> Iterator[str]:
        return iter(self._axes)

    def __len__(self) -> int:
        return len(self._axes)

    @cached_property
    def _axes(self) -> dict[str, AxisEstimate]:
        total, hadamard = self._total_and_hadamard()
        return {
            axis: AxisEstimate(
                axis,
                _deviations(self._estimate.curve, i),
                np.sqrt(self._estimate.fitted[:, i]),
                self._coefficients(axis),
                None if total is None else _deviations(total, i),
                None if hadamard is None else _deviations(hadamard, i),
            )
            for i, axis in measured_axes(self._estimate.curve)
        }

    def _coefficients(self, axis: str) -> dict[str, Coefficient]:
        known, i = self._estimate.coefficients, AXES.index(axis)
        return {
            symbol: Coefficient(
                symbol, axis, float(known.value[row, i]), float(known.lo[row, i]), float(known.hi[row, i]),
                Status(int(known.status[row, i])).name.lower(),
            )
            for row, symbol in enumerate(SYMBOLS)
        }  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary of plain Python objects.

        The keys are those of ``imu-monitor analyze --json`` (docs/reference/analyze-format.md). A number that is not
        finite is None.
        """
        result: dict[str, Any] = msgspec.json.decode(self._message().encode())
        return result

    def to_dataframe(self, table: Literal["coefficients", "deviations"] = "coefficients") -> "pd.DataFrame":
        """Return the noise coefficients or the Allan deviations as a pandas DataFrame, in SI units.

        Parameters
        ----------
        table : {"coefficients", "deviations"}
            Rows of the table: one coefficient of one axis, or one averaging time of one axis.

        Raises
        ------
        ConfigError
            If pandas is not installed, or if the table is unknown.
        """
        rows: list[dict[str, Any]]
        if table == "coefficients":
            names = ("axis", "symbol", "value", "lo", "hi", "status", "unit")
            found = [one for axis in self.values() for one in axis.coefficients.values()]
            return build_dataframe({name: [getattr(one, name) for one in found] for name in names})
        if table == "deviations":
            rows = [
                {"axis": axis, "tau_s": tau_s, "deviation": deviation, "lo": lo, "hi": hi, "fitted": fitted}
                for axis, one in self.items()
                for tau_s, deviation, lo, hi, fitted in zip(
                    one.allan.tau_s, one.allan.deviation, one.allan.lo, one.allan.hi, one.fitted, strict=True
                )
            ]
            return build_dataframe({name: [row[name] for row in rows] for name in rows[0]} if rows else {})
        raise ConfigError(f'table: "{table}"; possible are coefficients, deviations')

    def _message(self) -> AnalysisMessage:
        estimate = self._estimate
        coefficients = coefficient_values(estimate.coefficients, estimate.k_or_r)
        axes = {
            axis: AxisAnalysis(
                allan=AxisDeviations.from_curve(estimate.curve, i),
                coefficients=coefficients[i],
                bandwidth=None,
            )
            for i, axis in measured_axes(estimate.curve)
        }
        return AnalysisMessage(
            rate=self.rate_hz,
            samples=estimate.curve.n,
            seconds=self.duration_s,
            notes=(),
            axes=axes,
            motions=[],
            changes=[],
        )

    def _total_and_hadamard(self) -> tuple[VarianceCurve | None, VarianceCurve | None]:
        return None, None

    def _axes_of_temperature(self) -> tuple[str, ...]:
        return ()

    def _draw(self, units: UnitSystem, title: str) -> "Figure":
        from monitor.publishing.plots.analysis_plot import draw_analysis_figure

        return draw_analysis_figure(self._estimate, units=units, title=title)

    def __repr__(self) -> str:
        duration = format_duration(self.duration_s)
        return f"<{type(self).__name__} of {' '.join(self) or 'no axis'}: {self._estimate.curve.n} samples, {duration}>"

    def __str__(self) -> str:
        from monitor.publishing.terminal.coefficient_tables import print_analysis

        return render_text(
            lambda console: print_analysis(
                self._estimate, self._axes_of_temperature(), self.notes, DEFAULT_UNITS, console
            )
        )

    def _repr_html_(self) -> str:
        """Return the table, and the Allan plot if matplotlib is installed."""
        from monitor.publishing.plots.style import RASTER_DPI, figure_style, to_svg_element

        try:
            with figure_style():
                figure = self._draw(DEFAULT_UNITS, "")
                figure.set_dpi(RASTER_DPI)
                return render_html(str(self), [to_svg_element(figure, "Allan deviations")])
        except ConfigError:
            return render_html(str(self))


def plot_allan(
    estimate: AllanEstimate, *, units: Literal["imu", "datasheet", "si"] = "imu", title: str = ""
) -> "Figure":
    """Draw Allan deviations with fit and 95 % bands, and a table of the coefficients.

    Parameters
    ----------
    estimate : AllanEstimate
        Result of ``analyze`` or of ``AllanWindow.estimate``.
    units : {"imu", "datasheet", "si"}
        Units of the figure: °/h and °/√h, the same with noise densities in m°/s/√Hz, or rad/s.
    title : str
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        Figure with one column of panels for gyroscopes and one for accelerometers. ``figure.savefig(path)`` writes it
        to a file.

    Raises
    ------
    ConfigError
        If matplotlib is not installed, or if the units are unknown.

    Examples
    --------
    >>> import imu_monitor
    >>> estimate = imu_monitor.analyze(imu_monitor.simulate("mti-1", duration_s=600.0))
    >>> figure = imu_monitor.plot_allan(estimate, title="bench")
    >>> len(figure.axes)  # an Allan plot and a table for gyroscopes and for accelerometers
    4
    """
    if units not in UNIT_SYSTEMS:
        raise ConfigError(f'units: "{units}"; possible are {", ".join(UNIT_SYSTEMS)}')
    return estimate._draw(UNIT_SYSTEMS[units], title)  # noqa: SLF001 - the subclasses draw different panels


def _deviations(curve: AllanCurve | VarianceCurve, axis: int) -> Deviations:
    return Deviations(curve.tau_s, *deviations_with_interval_ends(curve, axis))
