"""Checked parameters: limits as ROS descriptor ranges, errors that name the parameter, changes while unconfigured."""

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.context import Context
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter

from active6d_core.nearest_name import did_you_mean
from active6d_core.se3 import transform_from_quaternion
from active6d_core.structured_text import parse_yaml

_LARGEST_INTEGER = 2**63 - 1


@dataclass(frozen=True)
class ParameterLimits:
    """Which values a parameter may have; None where there is no limit.

    Attributes:
        minimum: least value, itself allowed.
        maximum: largest value, itself allowed.
        choices: the only values of a text parameter.
    """

    minimum: float | None = None
    maximum: float | None = None
    choices: Sequence[str] | None = None

    def __str__(self) -> str:
        parts = [f">= {self.minimum}"] * (self.minimum is not None) + [f"<= {self.maximum}"] * (
            self.maximum is not None
        )
        if self.choices is not None:
            parts.append("one of " + ", ".join(self.choices))
        return " and ".join(parts)

    def allow(self, value: Any) -> bool:
        """Whether the value is within the limits; NaN never is within a range."""
        low = self.minimum is not None and not value >= self.minimum
        high = self.maximum is not None and not value <= self.maximum
        return not (low or high or (self.choices is not None and value not in self.choices))

    def descriptor(self, default: Any, description: str, read_only: bool) -> ParameterDescriptor:
        """The limits as ROS tools show them: a range for numbers, a text for choices."""
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        if self.choices is not None:
            descriptor.additional_constraints = "one of " + ", ".join(self.choices)
        if self.minimum is None and self.maximum is None:
            return descriptor
        if isinstance(default, int):
            low: float = -_LARGEST_INTEGER if self.minimum is None else int(self.minimum)
            high: float = _LARGEST_INTEGER if self.maximum is None else int(self.maximum)
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        else:
            low = -sys.float_info.max if self.minimum is None else float(self.minimum)
            high = sys.float_info.max if self.maximum is None else float(self.maximum)
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        return descriptor


def describe_limits(descriptor: ParameterDescriptor) -> str:
    """A descriptor's limits in words, empty without any; ends of a range that are no limit are left out."""
    parts = []
    for limit in (*descriptor.integer_range, *descriptor.floating_point_range):
        largest = _LARGEST_INTEGER if isinstance(limit, IntegerRange) else sys.float_info.max
        parts += [f">= {limit.from_value}"] * (limit.from_value > -largest)
        parts += [f"<= {limit.to_value}"] * (limit.to_value < largest)
    return "; ".join([*parts, *filter(None, [descriptor.additional_constraints])])


class ParameterNode(LifecycleNode):
    """A lifecycle node whose parameters are checked, and can be set until it is configured.

    Subclasses keep ``_configured`` up to date.
    """

    def __init__(
        self,
        name: str,
        *,
        context: Context | None = None,
        namespace: str = "",
        overrides: dict[str, Any] | None = None,
    ) -> None:
        parameters = [Parameter(key, value=value) for key, value in (overrides or {}).items()]
        super().__init__(name, context=context, namespace=namespace, parameter_overrides=parameters)
        self._configured = False
        self._parameter_limits: dict[str, ParameterLimits] = {}
        self.add_on_set_parameters_callback(self._check_set)

    def declare(
        self,
        name: str,
        default: Any,
        description: str,
        *,
        minimum: float | None = None,
        maximum: float | None = None,
        choices: Sequence[str] | None = None,
        fixed: bool = False,
    ) -> None:
        """Declare a parameter that can be set while the node is unconfigured; ``fixed``: only when it is started."""
        limits = ParameterLimits(minimum, maximum, choices)
        try:
            self.declare_parameter(name, default)
            self.get_parameter(name)  # fails where the value is empty
        except (
            InvalidParameterTypeException,
            InvalidParameterValueException,
            ParameterUninitializedException,
        ) as error:
            expected = f"a {type(default).__name__} such as {default!r}"
            raise ValueError(f"{self.get_name()}: parameter '{name}' must be {expected} ({error})") from error
        if not limits.allow(self.value(name)):
            raise ValueError(f"{self.get_name()}: parameter '{name}' is {self.value(name)!r}, must be {limits}")
        descriptor = limits.descriptor(default, description, fixed)
        descriptor.type = self.get_parameter(name).type_.value
        self.set_descriptor(name, descriptor)
        self._parameter_limits[name] = limits

    def value(self, name: str) -> Any:
        """The value of a declared parameter; arrays are lists."""
        value = self.get_parameter(name).value
        return value.tolist() if hasattr(value, "tolist") else value

    def unknown_parameters(self) -> list[str]:
        """A sentence for each value that was given when the node started and that no parameter of it takes."""
        known = set(self._parameters)
        return [
            f"parameter '{name}' is unknown and has no effect{did_you_mean(name, known)}"
            for name in self._parameter_overrides
            if name not in known and not name.startswith("qos_overrides.")
        ]

    def rigid_transform(self, name: str) -> np.ndarray:
        """(4, 4) transform of a parameter that holds x y z in metres and the quaternion qx qy qz qw.

        Raises:
            ValueError: it holds something else; the message names the parameter.
        """
        numbers = np.array(self.value(name), float)
        if numbers.shape != (7,) or not abs(np.linalg.norm(numbers[3:]) - 1.0) <= 1e-3:
            raise ValueError(f"{self.get_name()}: parameter '{name}' must be x y z and a unit quaternion qx qy qz qw")
        return transform_from_quaternion(numbers[3:], numbers[:3])

    def mapping(self, name: str) -> dict[str, Any]:
        """The value of a text parameter that holds a YAML mapping.

        Raises:
            ValueError: it holds something else; the message names the parameter.
        """
        try:
            value = parse_yaml(self.value(name))
        except ValueError:
            value = None
        if not isinstance(value, dict):
            raise ValueError(f"{self.get_name()}: parameter '{name}' must be a YAML mapping")
        return value

    def _check_set(self, parameters: Iterable[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            limits = self._parameter_limits.get(parameter.name)
            if limits is None:
                continue
            if self._configured:
                reason = (
                    f"'{parameter.name}' can be set only while the node is unconfigured: "
                    f"`ros2 lifecycle set {self.get_fully_qualified_name()} deactivate`, then cleanup"
                )
                return SetParametersResult(successful=False, reason=reason)
            if not limits.allow(parameter.value):
                reason = f"'{parameter.name}' is {parameter.value!r}, must be {limits}"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)
