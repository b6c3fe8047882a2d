"""The right LLVM library is chosen before Dr.Jit is imported; a wrong one is refused before it aborts the process."""

from __future__ import annotations

import builtins
import json
import os
import subprocess
import sys
import textwrap

import pytest

from atmo_jit import llvm
from atmo_jit.errors import LLVMError

VARIABLE = llvm.VARIABLE

needs_wheel = pytest.mark.skipif(
    llvm.wheel_library() is None, reason=f"{llvm.WHEEL} is not in this environment (it exists for Linux on x86-64 only)"
)


def fresh(code, **environment):
    """What a new Python process prints, as JSON. Variables given as None are unset."""
    variables = {**os.environ, VARIABLE: None, **environment}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        env={name: value for name, value in variables.items() if value is not None},
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


IMPORT = """
    import atmo_jit, json, os, sys
    print(json.dumps([os.environ.get("DRJIT_LIBLLVM_PATH"), sorted(sys.modules)]))
"""
ASK = """
    import json
    from atmo_jit import llvm
    try:
        llvm.require_llvm()
        print(json.dumps(None))
    except llvm.LLVMError as error:
        print(json.dumps(str(error)))
"""


@needs_wheel
def test_import_chooses_the_wheel_and_imports_nothing_heavy():
    path, modules = fresh(IMPORT)
    assert path == llvm.wheel_library() and os.path.isfile(path) and not os.path.islink(path)
    heavy = {"numpy", "drjit", "mitsuba", "colour", "click", "rich", "scipy", "matplotlib"}
    assert heavy.isdisjoint(modules)


def test_the_users_choice_stays():
    assert fresh(IMPORT, DRJIT_LIBLLVM_PATH="/users/libLLVM.so")[0] == "/users/libLLVM.so"


@needs_wheel
def test_a_solve_is_allowed_with_the_wheel_and_minimum_compiles():
    code = """
        import json
        import atmo_jit
        atmo_jit.llvm.require_llvm()
        import drjit as dr
        from drjit.llvm.ad import Float
        print(json.dumps([list(dr.minimum(Float(1, 2, 3), 2)), vars(atmo_jit.llvm.examine())]))
    """
    values, state = fresh(code)
    assert values == [1, 2, 2]
    assert state["origin"] == "environment" and state["remedy"] is None and not state["drjit_imported_first"]
    assert os.path.samefile(state["path"], llvm.wheel_library())
    assert int(state["version"].split(".")[0]) >= llvm.OLDEST


@needs_wheel
def test_drjit_imported_first_is_reported():
    code = """
        import drjit, json
        from atmo_jit import llvm
        print(json.dumps(vars(llvm.examine())))
    """
    state = fresh(code)
    assert state["drjit_imported_first"] and state["origin"] == "system"
    if state["remedy"]:
        assert "import atmo_jit before drjit" in state["remedy"] and llvm.wheel_library() in state["remedy"]


def test_a_library_that_is_not_there():
    message = fresh(ASK, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert message.startswith("DRJIT_LIBLLVM_PATH is '/nowhere/libLLVM.so', which is not a file; ")


@pytest.mark.parametrize("name", ["libLLVM-15.so.1", "libLLVM-16.so", "libLLVM.so.16.0", "libLLVM-14.so.1"])
def test_old_libraries_are_refused_by_name_without_being_loaded(tmp_path, name):
    (tmp_path / name).touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / name)
    for path in (tmp_path / name, tmp_path / "libLLVM.so"):
        message = fresh(ASK, DRJIT_LIBLLVM_PATH=str(path))
        assert " would abort the process, Dr.Jit needs 17 or newer; " in message and str(path) in message


def test_a_file_that_is_no_library(tmp_path):
    (tmp_path / "libLLVM.so").write_text("nothing of the kind")
    assert "is not an LLVM library that Dr.Jit can use" in fresh(ASK, DRJIT_LIBLLVM_PATH=str(tmp_path / "libLLVM.so"))


@pytest.mark.parametrize("version", [None, "-1.-1.-1", "11.0.1", "15.0.6", "16.0.6"])
def test_versions_that_do_not_work_get_a_remedy_in_one_line(monkeypatch, version):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "wheel_library", lambda: None)
    remedy = llvm._remedy(version, None)
    assert "pip install karellen-llvm-core" in remedy and "\n" not in remedy


@pytest.mark.parametrize("version", ["17.0.6", "18.1.8", "19.1.7", "23.1.4"])
def test_versions_that_work(version):
    assert llvm._remedy(version, "libLLVM.so") is None


def test_require_llvm_raises_what_examine_found(monkeypatch):
    monkeypatch.setattr(llvm, "_checked", False)
    monkeypatch.setattr(llvm, "_before_import", lambda: None)
    monkeypatch.setattr(llvm, "examine", lambda: llvm.LLVM("15.0.6", "x", "system", False, "do this"))
    with pytest.raises(LLVMError, match="^do this$"):
        llvm.require_llvm()


def test_the_newest_usable_file_is_taken_and_links_only_at_need(tmp_path):
    for name in ("libLLVM-16.so", "libLLVM.so.18.1", "libLLVM.so.23.1", "libLLVMSomething.so", "libLTO.so.99.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-23.so").symlink_to("libLLVM.so.23.1")
    (tmp_path / "libLLVM-31.so").symlink_to("gone.so")
    assert llvm._newest(llvm._files_in(str(tmp_path))) == str(tmp_path / "libLLVM.so.23.1")
    assert llvm._newest([str(tmp_path / "libLLVM-16.so")]) is None
    assert llvm._files_in(str(tmp_path / "none")) == []


def test_a_process_that_dies_is_survived(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false" if os.path.exists("/bin/false") else "/usr/bin/false")
    state = llvm.examine_apart()
    assert state.version is None and "ended with status 1" in state.remedy
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert "did not start" in llvm.examine_apart().remedy


def test_a_missing_system_library_is_named_behind_the_error_of_drjit_itself(monkeypatch):
    def fails(name, *arguments, **options):
        if name != "drjit":
            return real(name, *arguments, **options)
        try:
            raise ImportError("libatomic.so.1: cannot open shared object file: No such file or directory")
        except ImportError:
            raise NameError("name '_drjit_ext' is not defined")  # noqa: B904 (as Dr.Jit 1.5 does)

    real = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", fails)
    state = llvm.examine()
    assert state.version is None
    assert state.remedy.startswith("Dr.Jit cannot be imported: libatomic.so.1 is not on this system; install it")
    assert "apt install libatomic1" in state.remedy and "\n" not in state.remedy
    assert llvm.missing_library(ImportError("no module named x")) is None
