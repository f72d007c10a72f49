"""Loading one unit of a file: what is wrong with the file is said with line and key."""

from pathlib import Path

import pytest

from busway.config.files.file_error import FileError
from busway.config.profiles.loading import load_profile
from busway.errors import ConfigError


@pytest.mark.parametrize(("required", "key"), [("[3]", "required[0]"), ('[["x"]]', "required[0]"), ("3", "required")])
def test_names_of_required_parameters_that_are_no_texts_are_said_with_line_and_key(
    tmp_path: Path, required: str, key: str
) -> None:
    path = tmp_path / "profile.toml"
    path.write_text(f"\nrequired = {required}\n[[unit]]\n")
    with pytest.raises(FileError) as caught:
        load_profile(str(path), unit=1)
    [problem] = caught.value.problems
    assert (problem.file, problem.line, problem.key) == (str(path), 2, key)


def test_a_required_parameter_is_given_or_missed_by_name(tmp_path: Path) -> None:
    path = tmp_path / "profile.toml"
    path.write_text('required = ["x"]\n[[unit]]\n')
    assert load_profile(str(path), unit=7, parameters={"x": 1}).unit == [7]
    with pytest.raises(ConfigError, match="needs the parameter 'x'"):
        load_profile(str(path), unit=7)
