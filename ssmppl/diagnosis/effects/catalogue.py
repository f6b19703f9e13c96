"""The catalogue: effects that are looked for unless the user says otherwise, by canonical name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from ssmppl.diagnosis.effects import catalogue_input, catalogue_motion, catalogue_sensor, effect
from ssmppl.diagnosis.effects.effect import Effect
from ssmppl.errors import ArgumentError, listing


class Catalogue:
    """Effects by name; several forms of one item share a name.

    Iterating gives every form. What users need to declare their own stands here too.

    Parameters
    ----------
    effects : those that it holds.

    Examples
    --------
    >>> from ssmppl import effects
    >>> "coulomb friction" in effects.names()
    True
    >>> [e.form for e in effects.get("hard stop")]
    ['upper', 'lower', 'overflow into another state']
    """

    Auxiliary = effect.Auxiliary
    numbers = staticmethod(effect.numbers)
    sds = staticmethod(effect.sds)
    means = staticmethod(effect.means)
    firsts = staticmethod(effect.firsts)
    quantiles = staticmethod(effect.quantiles)
    sizes = staticmethod(effect.sizes)
    rows = staticmethod(effect.rows)

    def __init__(self, effects: Iterable[Effect]):
        self._effects = tuple(effects)

    def __iter__(self) -> Iterator[Effect]:
        return iter(self._effects)

    def __len__(self) -> int:
        return len(self._effects)

    def names(self) -> list[str]:
        """The canonical names, one per item.

        Returns
        -------
        list of str
            In the order of the catalogue.
        """
        return list(dict.fromkeys(e.name for e in self._effects))

    def get(self, name: str) -> list[Effect]:
        """The forms of one item.

        Parameters
        ----------
        name : one of `names()`.

        Returns
        -------
        list of Effect
            One for each form.

        Raises
        ------
        ArgumentError : there is no such item; lists the names.
        """
        found = [e for e in self._effects if e.name == name]
        if not found:
            raise ArgumentError(
                f"there is no effect called {name!r}",
                fix=f"its names are: {listing(str(name), self.names())}",
            )
        return found

    def __repr__(self) -> str:
        lines = [f"{len(self.names())} effects"]
        for e in self._effects:
            form = f" ({e.form})" if e.form else ""
            lines.append(f"  {e.name + form:<52} {e.kind:<12} {e.note}")
        return "\n".join(lines)


effects = Catalogue(
    (*catalogue_motion.EFFECTS, *catalogue_input.EFFECTS, *catalogue_sensor.EFFECTS)
)
