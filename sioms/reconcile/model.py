"""The model of an axis: the nominal plant, its controller, and the effects that are switched on.

Units are the axis's own: {x} is m or rad, {F} is N or N m; everything else SI.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np

from sioms.reconcile.effect import Array, Effect, Parameter, Ref
from sioms.reconcile.effects import known


@dataclass(frozen=True, slots=True)
class Controller:
    """Discrete servo law of the axis.

    u[n] = clip(k (e[n] + kz e[n-1]) - kp u[n-1] + kb v[n] + offset, +-limit), e = command - position,
    v the first difference of position through one pole at ``velocity_filter_hz`` (0: no filter), or, with
    ``velocity_mean``, the difference of the mean of two samples.
    """

    k: float
    kz: float
    kp: float
    kb: float
    offset: float
    limit: float
    velocity_filter_hz: float
    velocity_mean: bool = False


@dataclass(frozen=True, slots=True)
class AxisModel:
    """Nominal rigid axis plus effects. Immutable.

    Attributes:
        rotary: True for rad and N m, False for m and N.
        sample_time_s: controller period.
        inertia: kg or kg m^2.
        viscous: N s/m or N m s/rad.
        resolution: position per count.
        pitch: distance of index marks; the period of cogging and of everything periodic.
        rated_force: continuous force, the natural size of forces and the unit of heating.
        max_speed: natural size of speeds.
        controller: None where only recorded forces are at hand.
        effects: values per parameter symbol per effect name; only what is switched on.
        refine: base parameters ("inertia", "viscous") that are uncertain and fitted along, not named.
        driven: False where the axis has no drive: it swings or coasts freely, or only ``external`` moves it.
        imposed: another machine imposes the motion, and the force is what that takes, as on a friction rig.
        swings_hz: how fast the motion is that was recorded, and steps of the simulation have to follow; 0: nobody said.
        within: bounds of numbers in ``refine`` while effects are searched; one without is only kept from zero.
    """

    rotary: bool
    sample_time_s: float
    inertia: float
    viscous: float
    resolution: float
    pitch: float
    rated_force: float
    max_speed: float
    controller: Controller | None = None
    start_position: float = 0.0
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    refine: tuple[str, ...] = ()
    name: str = "axis"
    driven: bool = True
    imposed: bool = False
    swings_hz: float = 0.0
    within: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def position_unit(self) -> str:
        """m or rad."""
        return "rad" if self.rotary else "m"

    @property
    def force_unit(self) -> str:
        """N or N m."""
        return "N m" if self.rotary else "N"

    def with_effect(self, name: str, values: Mapping[str, float]) -> AxisModel:
        """Return the model with one effect switched on (or its values changed)."""
        known()[name].values(values)
        return replace(self, effects={**self.effects, name: dict(values)})

    def without_effect(self, name: str) -> AxisModel:
        """Return the model with one effect switched off."""
        return replace(self, effects={k: v for k, v in self.effects.items() if k != name})

    @property
    def base(self) -> AxisModel:
        """What has the numbers that may be refined: the axis itself."""
        return self

    def with_numbers(self, effects: Mapping[str, Mapping[str, float]], base: Mapping[str, float]) -> AxisModel:
        """Return the model with other numbers of its effects, and some of its own."""
        return replace(self, effects=effects, **base)  # type: ignore[arg-type]

    def scale(self, parameter: Parameter) -> float:
        """Natural size of a parameter on this axis, in its own unit."""
        match parameter.ref:
            case Ref.FORCE | Ref.RISE:
                return self.rated_force
            case Ref.PER_FORCE:
                return 1.0 / self.rated_force
            case Ref.INERTIA:
                return self.inertia
            case Ref.DAMPING:
                return self.rated_force / self.max_speed
            case Ref.STIFFNESS:
                return self.rated_force / self.pitch
            case Ref.DRAG:
                return self.rated_force / self.max_speed**2
            case Ref.SPEED:
                return self.max_speed
            case Ref.PITCH:
                return self.pitch
            case Ref.ONE | Ref.TIME | Ref.FREQUENCY | Ref.ANGLE:
                return 1.0

    def bounds(self, name: str, parameter: Parameter) -> tuple[float, float]:
        """Bounds of a parameter of an effect on this axis, in its own unit; those that the model states for it come
        first.
        """
        size = self.scale(parameter)
        return self.within.get(f"{name}.{parameter.symbol}", (parameter.lower * size, parameter.upper * size))

    def unit(self, parameter: Parameter) -> str:
        """Unit of a parameter on this axis."""
        return parameter.unit.format(F=self.force_unit, x=self.position_unit)

    def applicable(self, effect: Effect) -> bool:
        """Say whether the effect makes sense on this kind of axis."""
        return (effect.rotary if self.rotary else effect.linear) and not (self.imposed and effect.needs_drive)


def plant_row(model: AxisModel) -> SimpleNamespace:
    """Lay a model out as the time step reads it: numbers by the names of ``kernel``'s places, in lower case; what is
    absent is 0.
    """
    row = SimpleNamespace(
        inertia=model.inertia,
        viscous=model.viscous,
        dt=model.sample_time_s,
        quantum=model.resolution,
        gain_y=1.0,
        turn_x=2.0 * np.pi / model.pitch,
        limit=np.inf,
        rated=model.rated_force,
        tau_t=1.0,
        hyst_x=1.0,
    )
    entering = [(known()[name], given) for name, given in model.effects.items()]
    for effect, given in sorted(entering, key=lambda e: e[0].mechanism.last):
        effect.mechanism.enter(row, effect.values(given))
    return row


def controller_row(model: AxisModel) -> Array:
    """Pack the controller for the kernel.

    Raises:
        ValueError: the model has no controller.
    """
    c = model.controller
    if c is None:
        raise ValueError(f"simulate {model.name}: the model has no controller; a closed loop needs one")
    f = c.velocity_filter_hz
    alpha = 1.0 - np.exp(-2.0 * np.pi * f * model.sample_time_s) if f > 0.0 else 1.0
    return np.array([c.k, c.kz, c.kp, c.kb, c.offset, c.limit, alpha, float(c.velocity_mean)], dtype=np.float64)
