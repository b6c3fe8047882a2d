"""Which LLVM library Dr.Jit loads, and whether it can be used.

Dr.Jit picks its libLLVM once, when it is imported: the file named by ``DRJIT_LIBLLVM_PATH``, else what the system
offers. :func:`configure`, called when ``atmo_jit`` is imported, sets that variable to the library of the PyPI wheel
``karellen-llvm-core`` if it is in this environment, unless the user has set it. Nothing is loaded then.

LLVM before 17 cannot compile ``minimum`` and ``maximum`` on x86-64 ("Cannot select: fminimum") and aborts the
process; 17, 18, 19 and 23 were tried and work. :func:`require_llvm` raises an error with a remedy before that can
happen. It asks Dr.Jit itself for the version, after it has loaded the library and before anything is compiled, so
there is nothing to guess.
"""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass

from .errors import LLVMError, one_line
from .llvm_target import use_gathers

VARIABLE = "DRJIT_LIBLLVM_PATH"
WHEEL = "karellen-llvm-core"
OLDEST = 17

_NAME = re.compile(r"libLLVM(?:-|\.so\.)(\d+)")
_NOT_THERE = re.compile(r"(lib[^\s:/]+): cannot open shared object file")
_drjit_came_first = False
_configured: str | None = None
_checked = False


@dataclass(frozen=True)
class LLVM:
    """The LLVM library of this process: ``version`` (None: none was loaded), its file, who chose it, and what is wrong.

    ``origin`` is ``"user"`` (the variable was set), ``"environment"`` (found beside this Python) or ``"system"``;
    ``remedy`` is None when the library is usable.
    """

    version: str | None
    path: str | None
    origin: str
    drjit_imported_first: bool
    remedy: str | None


def configure() -> None:
    """Point ``DRJIT_LIBLLVM_PATH`` at the wheel's library, if that is there, it is unset and Dr.Jit not yet loaded."""
    global _drjit_came_first, _configured
    if "drjit" in sys.modules:
        _drjit_came_first = True
    elif not os.environ.get(VARIABLE):
        _configured = wheel_library()
        if _configured:
            os.environ[VARIABLE] = _configured


def wheel_library() -> str | None:
    """The newest usable libLLVM of this Python environment, where the wheel puts it, or None. Looks at names only."""
    if not sys.platform.startswith("linux"):
        return None
    found = _newest(_files_in(os.path.join(sys.prefix, "lib")))
    return found or _newest(_files_of_wheel())


def require_llvm() -> None:
    """Return if Dr.Jit's LLVM backend can be used in this process; import Dr.Jit to find out, if that has not happened.

    Raises :class:`~atmo_jit.errors.LLVMError`, one line that says what was found and what to do.
    """
    global _checked
    if _checked:
        return
    state = _before_import() if "drjit" not in sys.modules else None
    state = state or examine()
    if state.remedy:
        raise LLVMError(state.remedy)
    use_gathers()
    _checked = True


def examine() -> LLVM:
    """What Dr.Jit has loaded in this process. Imports Dr.Jit; compiles nothing."""
    try:
        import drjit as dr
    except Exception as error:
        found = missing_library(error)
        if found is None:
            raise
        return LLVM(None, os.environ.get(VARIABLE) or None, _origin(), _drjit_came_first, found)
    loaded = dr.has_backend(dr.JitBackend.LLVM)
    version = ".".join(map(str, dr.detail.llvm_version())) if loaded else None
    path = _mapped_library()
    return LLVM(version, path, _origin(), _drjit_came_first, _remedy(version, path))


def missing_library(error: BaseException | None) -> str | None:
    """What to do about a failed import of Dr.Jit or Mitsuba that lacked a shared library, in one line; else None.

    The binary wheels use libatomic, which comes with compilers and is not on minimal systems. Dr.Jit 1.5 fails while it
    reports that (NameError), so the whole chain of exceptions counts.
    """
    while error is not None:
        found = _NOT_THERE.match(str(error)) if isinstance(error, ImportError) else None
        if found:
            remedy = "from the system's packages"
            if found[1].startswith("libatomic."):
                remedy += " (Debian and Ubuntu: apt install libatomic1; Fedora: dnf install libatomic)"
            return f"Dr.Jit cannot be imported: {found[1]} is not on this system; install it {remedy}"
        error = error.__cause__ or error.__context__
    return None


def examine_apart(timeout_s: float = 60.0) -> LLVM:
    """The same for a new process with this environment: a library that crashes when loaded spares this one."""
    import json
    import subprocess

    code = "import json; from atmo_jit import llvm; print(json.dumps(vars(llvm.examine())))"
    command = [sys.executable, "-P", "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, env=_child_environment())
        if done.returncode == 0:
            state = json.loads(done.stdout)
            return LLVM(**state | {"origin": _origin(), "drjit_imported_first": _drjit_came_first})
        reason = f"ended with status {done.returncode}: {done.stderr[-300:]}"
    except subprocess.TimeoutExpired:
        reason = f"did not answer within {timeout_s:g} s"
    except OSError as error:
        reason = f"did not start: {error}"
    found = one_line(f"a process that loads Dr.Jit and LLVM {reason}; {_INSTALL}")
    return LLVM(None, os.environ.get(VARIABLE) or None, _origin(), _drjit_came_first, found)


_INSTALL = (
    f"install a newer one: pip install {WHEEL} (Linux on x86-64), or LLVM {OLDEST} or newer from the system's "
    f"packages, with {VARIABLE} set to its libLLVM before Python starts"
)


def _before_import() -> LLVM | None:
    """What is wrong with the library that the variable names, as far as its name tells, or None."""
    path = os.environ.get(VARIABLE)
    if not path or os.sep not in path:
        return None
    version = _major(os.path.realpath(path))
    if not os.path.isfile(path) or (version and version < OLDEST):
        state = str(version) if version and os.path.isfile(path) else None
        return LLVM(state, path, _origin(), _drjit_came_first, _remedy(state, path))
    return None


def _remedy(version: str | None, path: str | None) -> str | None:
    if version and int(version.split(".")[0]) >= OLDEST:
        return None
    named = os.environ.get(VARIABLE)
    if version:
        found = f"LLVM {version} ({path}) would abort the process, Dr.Jit needs {OLDEST} or newer"
    elif named and not os.path.isfile(named) and os.sep in named:
        found = f"{VARIABLE} is {named!r}, which is not a file"
    elif path or named:
        found = f"{path or named} is not an LLVM library that Dr.Jit can use, it needs {OLDEST} or newer"
    else:
        found = "Dr.Jit found no LLVM library"
    wheel = wheel_library()
    if wheel and _drjit_came_first:
        return f"{found}; import atmo_jit before drjit and mitsuba, or set {VARIABLE}={wheel} before Python starts"
    if wheel and named and _configured is None:
        return f"{found}; unset {VARIABLE}, and {wheel} will be used"
    return f"{found}; {_INSTALL}"


def _origin() -> str:
    named = os.environ.get(VARIABLE)
    if not named:
        return "system"
    return "environment" if named in (_configured, wheel_library()) else "user"


def _mapped_library() -> str | None:
    """The libLLVM file mapped into this process (Linux), else the one that the variable names."""
    try:
        with open("/proc/self/maps") as maps:
            names = {line.split(maxsplit=5)[-1].strip() for line in maps if "libLLVM" in line}
    except OSError:
        names = set()
    return min(names) if names else os.environ.get(VARIABLE) or None


def _files_in(folder: str) -> list[str]:
    try:
        return [os.path.join(folder, name) for name in os.listdir(folder) if name.startswith("libLLVM")]
    except OSError:
        return []


def _files_of_wheel() -> list[str]:
    """The library files of the wheel wherever pip put them (a user's site, a target folder)."""
    from importlib.metadata import PackageNotFoundError, files

    try:
        return [str(file.locate().resolve()) for file in files(WHEEL) or () if file.name.startswith("libLLVM")]
    except PackageNotFoundError:
        return []


def _newest(paths: list[str]) -> str | None:
    """The path of the newest version that is usable; the file itself rather than a link to it."""
    ranked = [(_major(path) or 0, not os.path.islink(path), path) for path in paths if os.path.isfile(path)]
    best = max(ranked, default=(0, False, ""))
    return best[2] if best[0] >= OLDEST else None


def _major(path: str) -> int | None:
    """Major version in a library's file name (``libLLVM-15.so``, ``libLLVM.so.23.1``), None where it has none."""
    match = _NAME.search(os.path.basename(path))
    return int(match[1]) if match else None


def _child_environment() -> dict[str, str]:
    """This environment, with this package's location first on the path so that the child imports the same code."""
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))}
