"""Objects as a caller gives them: the right kind, no two of one name."""

from collections.abc import Iterable, Sequence

from r2h_batch.bodies.objects import ObjectModel, load_objects
from r2h_batch.validate import describe_value


def checked_objects(objects: Sequence[ObjectModel] | None) -> tuple[ObjectModel, ...]:
    """The given objects, the built-in ones for None; no two of one name: rows name their object,
    and statistics go by it."""
    if objects is None:
        return load_objects()
    if isinstance(objects, (str, ObjectModel)) or not isinstance(objects, Iterable):
        what = repr(objects.name) if isinstance(objects, ObjectModel) else describe_value(objects)
        raise TypeError(
            f"objects is {what}; it must be a sequence of ObjectModel, such as load_objects(['cup'])"
        )
    found = tuple(objects)
    for i, o in enumerate(found):
        if not isinstance(o, ObjectModel):
            raise TypeError(
                f"objects[{i}] is {describe_value(o)}; it must be an ObjectModel, such as load_objects(['cup'])[0]"
            )
    names = [o.name for o in found]
    if twice := [n for n in names if names.count(n) > 1]:
        raise ValueError(
            f"two objects are called {twice[0]!r}; rows name their object, so give each its own name"
        )
    return found
