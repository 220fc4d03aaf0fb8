"""Optional libraries are imported only if needed, and the error without them says how to install them."""

import subprocess
import sys

import pytest


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
