"""Parameters of an estimator: the arguments of its constructor, each an attribute of the same name."""

from __future__ import annotations

import copy
import inspect
from typing import Any, TypeVar

Self = TypeVar("Self", bound="Parametrised")


class Parametrised:
    """Show, get and set parameters by name, as in scikit-learn."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{p}={getattr(self, p)!r}' for p in self._parameters())})"

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the constructor's parameters by name.

        Args:
            deep: include the parameters of a parameter that is itself an estimator, as ``start__seed``.
        """
        params = {name: getattr(self, name) for name in self._parameters()}
        if deep:
            for name, value in list(params.items()):
                if isinstance(value, Parametrised):
                    params |= {f"{name}__{key}": inner for key, inner in value.get_params().items()}
        return params

    def set_params(self: Self, **params: Any) -> Self:
        """Set parameters, checked by the constructor; results of an earlier ``fit`` stay until the next ``fit``.

        Raises:
            TypeError, ValueError: unknown parameter name, or a value that the constructor refuses; nothing changes.
        """
        changed = self.get_params(deep=False)
        nested: dict[str, dict[str, Any]] = {}
        for key, value in params.items():
            name, inside, rest = key.partition("__")
            if name not in changed:
                known = ", ".join(f"`{parameter}`" for parameter in changed) or "which has none"
                raise ValueError(
                    f"Expected parameters of {type(self).__name__}, {known}, but got `{name}`; use a listed name."
                )
            if inside:
                nested.setdefault(name, {})[rest] = value
            else:
                changed[name] = value
        for name, values in nested.items():
            if not isinstance(changed[name], Parametrised):
                raise ValueError(
                    f"Expected parameter `{name}` to be an estimator, to change its {', '.join(values)}, "
                    f"but got {changed[name]!r}; set `{name}` itself."
                )
            changed[name] = copy.copy(changed[name]).set_params(**values)
        checked = type(self)(**changed)
        for name in changed:
            setattr(self, name, getattr(checked, name))
        return self

    def _parameters(self) -> list[str]:
        return [name for name in inspect.signature(type(self).__init__).parameters if name != "self"]
