"""The systems whose equations are known, with the effects that can be hidden in each."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from examples.blind_proof.equations.hidden import System
from examples.blind_proof.equations.systems.drives import MOTOR, SERVO
from examples.blind_proof.equations.systems.mechanics import CART_POLE, PENDULUM, PROJECTILE
from examples.blind_proof.equations.systems.vessels import TANKS, THERMAL

SYSTEMS: Mapping[str, System] = MappingProxyType(
    {
        "pendulum": PENDULUM,
        "cart_pole": CART_POLE,
        "tanks": TANKS,
        "motor": MOTOR,
        "projectile": PROJECTILE,
        "thermal": THERMAL,
        "servo": SERVO,
    }
)
