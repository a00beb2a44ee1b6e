"""What is done around an import: a call once another package was imported, or an error of it as one kind of error."""

import sys
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType


def when_imported(name: str, call: Callable[[], object]) -> None:
    """Calls once a package has been imported by whomever, and never imports it.

    Args:
        name: a package of `sys.path`, without a dot.
        call: what to call; what it raises, the import raises.
    """
    if name in sys.modules:
        call()
    else:
        sys.meta_path.insert(0, _Watch(name, call))


def if_it_fails(name: str, call: Callable[[], object]) -> None:
    """Whatever a module raises while it is imported becomes an ImportError, after a call: importers of optional
    modules go on without it.

    Args:
        name: a module, with dots.
        call: what puts back what the module has changed.
    """
    if name not in sys.modules:
        sys.meta_path.insert(0, _Watch(name, call, _Forgiving))


class _Watch(MetaPathFinder):
    """Finds one package as Python does, with a loader that calls after it."""

    def __init__(
        self, name: str, call: Callable[[], object], loads: "type[_Around] | None" = None
    ) -> None:
        self.name, self.call, self.loads = name, call, loads or _Calling

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The package's spec; None for all other names, and where it is not installed."""
        if fullname != self.name:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = self.loads(spec.loader, self)
        return spec


class _Around(Loader):
    """Another loader, in whose place it stands until the module runs."""

    def __init__(self, loader: Loader, watch: _Watch) -> None:
        self.loader, self.watch = loader, watch

    def __getattr__(self, name: str) -> object:
        return getattr(self.loader, name)  # its source, its files

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """As the other loader."""
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """As the other loader, whose place in the module it leaves to it."""
        module.__loader__ = self.loader
        if module.__spec__ is not None:
            module.__spec__.loader = self.loader
        self.loader.exec_module(module)


class _Calling(_Around):
    """A call after the module ran, once."""

    def exec_module(self, module: ModuleType) -> None:
        """The module, then the call."""
        super().exec_module(module)
        if self.watch in sys.meta_path:
            sys.meta_path.remove(self.watch)
            self.watch.call()


class _Forgiving(_Around):
    """A call and an ImportError where the module raises something."""

    def exec_module(self, module: ModuleType) -> None:
        """The module; what it raises is an ImportError."""
        try:
            super().exec_module(module)
        except Exception as error:
            self.watch.call()
            raise ImportError(f"{module.__name__}: {type(error).__name__}: {error}") from error
