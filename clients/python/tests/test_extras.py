"""Optional libraries are imported only if needed, and the error without them says how to install them."""

import subprocess
import sys

import pytest

import twinstep


def run(code: str) -> subprocess.CompletedProcess[str]:
    """Run Python code in a separate process."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_the_package_imports_no_optional_library() -> None:
    code = (
        "import sys, twinstep.checker; print([name for name in ('torch', 'stable_baselines3') if name in sys.modules])"
    )
    assert run(code).stdout == "[]\n"


@pytest.mark.parametrize(
    ("module", "library", "extra"),
    [("sb3", "stable_baselines3", "sb3"), ("rsl_rl", "rsl_rl", "rsl-rl"), ("onnx", "onnx", "onnx")],
)
def test_error_names_the_extra_of_a_missing_library(module: str, library: str, extra: str) -> None:
    done = run(f"import sys; sys.modules[{library!r}] = None; import twinstep.{module}")
    assert done.returncode == 1
    assert f'is not installed here\n  pip install "twinstep[{extra}]"' in done.stderr


@pytest.mark.parametrize(
    ("module", "library", "extra"), [("sb3", "stable_baselines3", "sb3"), ("rsl_rl", "rsl_rl", "rsl-rl")]
)
def test_modules_of_extras_are_attributes_of_the_package(module: str, library: str, extra: str) -> None:
    code = f"import twinstep; print(twinstep.{module}.make_vec_env.__module__)"
    pytest.importorskip(library)
    assert run(code).stdout == f"twinstep.{module}\n"
    without = run(f"import sys; sys.modules[{library!r}] = None; {code}")
    assert f'is not installed here\n  pip install "twinstep[{extra}]"' in without.stderr


def test_misspelt_attribute_of_the_package_is_an_attribute_error() -> None:
    assert not hasattr(twinstep, "sb4")
    with pytest.raises(AttributeError, match="module `twinstep` has no attribute `sb4`"):
        _ = twinstep.sb4
