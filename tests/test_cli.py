"""The command line: lazy commands, exit statuses, one line on stderr; and what ``info`` says."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import types

import click
import pytest

import atmo_jit
from atmo_jit import cli, presets
from atmo_jit.errors import AtmosphereError, InputError, LLVMError


def run(*arguments, **options):
    return subprocess.run([sys.executable, "-m", "atmo_jit", *arguments], capture_output=True, text=True, **options)


@pytest.fixture
def broken(monkeypatch):
    """Make the command ``info`` raise what the test says."""

    def install(error):
        @click.command()
        def command():
            raise error

        monkeypatch.setitem(sys.modules, "atmo_jit.commands.info", types.SimpleNamespace(command=command))

    monkeypatch.delenv("ATMO_JIT_DEBUG", raising=False)
    return install


def test_help_lists_every_command_and_imports_none(capsys):
    assert cli.main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, text in cli.COMMANDS.items():
        assert any(line.split() == [name, *text.split()] for line in lines)
    code = "import sys; from atmo_jit import cli; cli.main(['--help']); print(*sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "click" in loaded
    assert [name for name in loaded if name.startswith(("atmo_jit.commands", "numpy", "drjit", "mitsuba"))] == []


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_has_help(name, capsys):
    assert cli.main([name, "--help"]) == 0
    assert f"Usage: atmo-jit {name} " in capsys.readouterr().out


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"atmo-jit, version {atmo_jit.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [([], "command"), (["nope"], "nope"), (["--nope"], "--nope"), (["info", "--nope"], "--nope"), (["info", "x"], "x")],
)
def test_bad_usage_is_one_line_and_status_2(arguments, named, capsys):
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("atmo-jit: ") and named in captured.err


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (InputError("views: x is\n3"), 2, "views: x is 3"),
        (AtmosphereError("mie.phase.g", "2", "less"), 2, "mie.phase.g: found 2; allowed: less"),
        (click.BadParameter("no\nway"), 2, "Invalid value: no way"),
        (LLVMError("install another"), 1, "install another"),
        (ValueError("inside"), 1, "ValueError: inside (atmo-jit --debug shows where)"),
        (
            OSError(28, "No space left on device"),
            1,
            "OSError: [Errno 28] No space left on device (atmo-jit --debug shows where)",
        ),
        (MemoryError(), 1, "MemoryError: (atmo-jit --debug shows where)"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_are_one_line_and_their_status(broken, capsys, error, status, text):
    broken(error)
    assert cli.main(["info"]) == status
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.strip() == f"atmo-jit: {text}"


@pytest.mark.parametrize("by_option", [True, False])
def test_debug_shows_the_traceback(broken, capsys, monkeypatch, by_option):
    broken(ValueError("inside"))
    if not by_option:
        monkeypatch.setenv("ATMO_JIT_DEBUG", "1")
    assert cli.main(["--debug", "info"] if by_option else ["info"]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err
    monkeypatch.setenv("ATMO_JIT_DEBUG", "0")
    assert cli.main(["info"]) == 1
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("end", ["time.sleep(60)", "no_other_way_out()", "Ignored(); time.sleep(60)"])
def test_an_interrupt_ends_with_130_and_a_line(number, end):
    # What a library makes of an interrupt within its own code may be another exception.
    # Jobs that a shell starts in the background ignore interrupts, and so would all processes below them.
    code = (
        "import signal, sys, time, types, click\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def no_other_way_out():\n"
        "    try:\n"
        "        time.sleep(60)\n"
        "    except KeyboardInterrupt:\n"
        "        raise RuntimeError('lost') from None\n"
        "class Ignored:\n"
        "    def __del__(self):\n"
        "        time.sleep(60)\n"
        "@click.command()\n"
        "def command():\n"
        "    print('ready', flush=True)\n"
        f"    {end}\n"
        "sys.modules['atmo_jit.commands.info'] = types.SimpleNamespace(command=command)\n"
        "from atmo_jit.cli import main\n"
        "sys.exit(main(['info']))"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            time.sleep(0.1)
            process.send_signal(number)
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == 130 and errors.strip() == "atmo-jit: interrupted"


def test_a_reader_that_goes_away_is_no_traceback():
    process = subprocess.Popen(
        [sys.executable, "-m", "atmo_jit", "info", "--preset", "earth"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    errors = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=30) == 1 and errors == b""


# --- info ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", presets.NAMES)
def test_info_prints_a_preset_that_can_be_loaded(name, capsys, tmp_path):
    assert cli.main(["info", "--preset", name]) == 0
    path = tmp_path / "air.json"
    path.write_text(capsys.readouterr().out)
    assert atmo_jit.Atmosphere.load(path) == atmo_jit.Atmosphere.load(name)


def test_info_describes_a_preset_at_other_wavelengths(capsys):
    assert cli.main(["info", "--preset", "earth", "--wavelengths", "440,500,550"]) == 0
    air = atmo_jit.Atmosphere(json.loads(capsys.readouterr().out))
    assert air.wavelengths_nm.tolist() == [440.0, 500.0, 550.0]
    # Its own values where it has them, the cross section's shape in between.
    assert air.rayleigh.scattering_per_m[[0, 2]] == pytest.approx([3.31e-5, 1.3558e-5])
    assert air.rayleigh.scattering_per_m[1] == pytest.approx(1.3558e-5 * (550 / 500) ** 4.05, rel=0.01)
    assert cli.main(["info", "--preset", "earth", "--wavelengths", "440;500"]) == 2
    assert "--wavelengths: found '440;500'; allowed: fast, or numbers > 0 (nm)" in capsys.readouterr().err
    assert cli.main(["info", "--wavelengths", "fast"]) == 2


def test_info_refuses_an_unknown_preset(capsys):
    assert cli.main(["info", "--preset", "venus"]) == 2
    assert capsys.readouterr().err == (
        "atmo-jit: --preset: found 'venus'; allowed: " + ", ".join(presets.NAMES) + "\n"
    )


def test_info_says_what_is_installed():
    done = run("info", "--json")
    assert done.returncode == 0 and done.stderr == ""
    found = json.loads(done.stdout)
    import drjit
    import mitsuba
    import numpy

    assert found["packages"]["numpy"] == numpy.__version__
    assert found["packages"]["drjit"] == drjit.__version__
    assert found["packages"]["mitsuba"] == mitsuba.__version__
    assert found["variants"] == list(mitsuba.variants())
    assert found["atmo_jit"] == atmo_jit.__version__ and found["presets"] == presets.SOURCES
    assert found["llvm"]["usable"] and found["llvm"]["version"]


def test_info_reports_an_unusable_llvm_and_still_ends_well(tmp_path):
    library = tmp_path / "libLLVM.so"
    library.write_text("no")
    done = run("info", env={**os.environ, "DRJIT_LIBLLVM_PATH": str(library)})
    assert done.returncode == 0
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("LLVM ")]
    assert "not usable (named by DRJIT_LIBLLVM_PATH)" in line and str(library) in line


def test_info_without_packages(monkeypatch):
    from atmo_jit.commands import info

    monkeypatch.setattr(info, "_version", lambda package: None)
    found = info.collect()
    assert found["variants"] == [] and found["llvm"] is None
    assert "drjit                not installed" in info._as_text(found)


# --- the package's names -------------------------------------------------------------------------------------------


def test_every_public_name_is_there():
    for name in atmo_jit.__all__:
        assert getattr(atmo_jit, name) is not None
    assert set(atmo_jit.__all__) <= set(dir(atmo_jit))
    with pytest.raises(AttributeError, match="has no attribute 'nope'"):
        _ = atmo_jit.nope


@pytest.mark.parametrize(
    "imports",
    [
        "import atmo_jit",
        "import atmo_jit.sky",
        "from atmo_jit.sky import Sky; import atmo_jit",
        "from atmo_jit import sky; import atmo_jit; assert sky is atmo_jit.sky",
        "from atmo_jit import Sky; import atmo_jit",
        "import atmo_jit.sky as module; assert module.Sky; import atmo_jit",
        "import importlib; importlib.import_module('atmo_jit.sky'); import atmo_jit",
    ],
)
def test_sky_is_callable_whoever_imports_what_first(imports):
    check = (
        "import inspect, sys\n"
        "assert callable(atmo_jit.sky)\n"
        "module = sys.modules['atmo_jit.sky']\n"
        "assert inspect.signature(atmo_jit.sky) == inspect.signature(module.sky)\n"
        "module.sky = lambda *arguments, **options: (arguments, options)\n"
        "assert atmo_jit.sky('earth', {}, tolerance=0.1) == (('earth', {}), {'tolerance': 0.1})"
    )
    done = subprocess.run([sys.executable, "-c", f"{imports}\n{check}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_closed_streams_are_nobodys(closed):
    command = f"{sys.executable} -m atmo_jit info --preset earth {closed}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
