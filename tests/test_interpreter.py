"""Free-threaded Pythons are refused when the package is imported, with a sentence."""

import subprocess
import sys

import pytest

from busway.interpreter import refuse_free_threading


def test_the_usual_build_is_taken() -> None:
    refuse_free_threading()


def test_an_interpreter_without_its_lock_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "_is_gil_enabled", lambda: False, raising=False)
    with pytest.raises(ImportError, match="does not run on a free-threaded Python"):
        refuse_free_threading()


def test_a_free_threaded_build_whose_lock_is_on_is_refused_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "_is_gil_enabled", lambda: True, raising=False)
    refuse_free_threading()
    monkeypatch.setattr(sys, "abiflags", "t", raising=False)
    with pytest.raises(ImportError, match="use the usual build of Python"):
        refuse_free_threading()


@pytest.mark.parametrize("fake", ["sys._is_gil_enabled = lambda: False", "sys.abiflags = 't'"])
def test_the_package_is_not_imported_there(fake: str) -> None:
    program = f"import sys; {fake}\ntry:\n    import busway\nexcept ImportError as error:\n    print(error)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=True)
    assert done.stdout.startswith("busway does not run on a free-threaded Python: ")
    assert len(done.stdout.splitlines()) == 1
