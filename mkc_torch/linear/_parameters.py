"""The parameters of an estimator: its constructor's, each an attribute of the same name."""

from __future__ import annotations

import copy
import inspect
from typing import Any, TypeVar

Self = TypeVar("Self", bound="Parametrised")


class Parametrised:
    """Parameters that are shown, asked for and changed by name, as scikit-learn does it."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{p}={getattr(self, p)!r}' for p in self._parameters())})"

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The parameters of the constructor by name.

        Args:
            deep: those of a parameter that is an estimator too, as ``start__seed``.
        """
        params = {name: getattr(self, name) for name in self._parameters()}
        if deep:
            for name, value in list(params.items()):
                if isinstance(value, Parametrised):
                    params |= {f"{name}__{key}": one for key, one in value.get_params().items()}
        return params

    def set_params(self: Self, **params: Any) -> Self:
        """Change parameters, which the constructor checks; results of an earlier ``fit`` stay until the next.

        Raises:
            TypeError, ValueError: no parameter of this name, or a value that the constructor refuses; nothing changes.
        """
        changed = self.get_params(deep=False)
        nested: dict[str, dict[str, Any]] = {}
        for key, value in params.items():
            name, inside, rest = key.partition("__")
            if name not in changed:
                known = ", ".join(f"`{one}`" for one in changed) or "of which there are none"
                raise ValueError(f"Expected parameters of {type(self).__name__}, {known}, but got `{name}`.")
            if inside:
                nested.setdefault(name, {})[rest] = value
            else:
                changed[name] = value
        for name, values in nested.items():
            if not isinstance(changed[name], Parametrised):
                raise ValueError(
                    f"Expected parameter `{name}` to be an estimator, to change its {', '.join(values)}, "
                    f"but got {changed[name]!r}."
                )
            changed[name] = copy.copy(changed[name]).set_params(**values)
        checked = type(self)(**changed)
        for name in changed:
            setattr(self, name, getattr(checked, name))
        return self

    def _parameters(self) -> list[str]:
        return [name for name in inspect.signature(type(self).__init__).parameters if name != "self"]
