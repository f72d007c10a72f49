"""No command shows a secret that a collector file names; `apps/collector/test_no_secrets.py` has everything else."""

import os
import signal
import threading
from pathlib import Path

import pytest
from waiting import wait_until

SECRETS = {"file": "in-a-file-7d3k", "variable": "in-the-environment-4p9s"}
PLANT = """\
[collector]
store = "data"
page = "127.0.0.1:0"
[poll_class]
all.period = 0.1
[[link]]
name = "a"
url = "tcp://127.0.0.1:9"
[[device]]
name = "meter-7"
link = "a"
unit = 1
profile = "meter"
[[sink]]
name = "broker"
url = "mqtt://collector@127.0.0.1:9"
password_file = "secret"
[[sink]]
name = "history"
url = "influxdb+http://127.0.0.1:9/write"
token_variable = "BUSWAY_TEST_TOKEN"
"""


def test_no_command_shows_a_secret(
    run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("BUSWAY_TEST_TOKEN", SECRETS["variable"])
    secret, file = tmp_path / "secret", tmp_path / "plant.toml"
    secret.write_text(SECRETS["file"])
    secret.chmod(0o600)
    file.write_text(PLANT)
    told = []
    for command in (
        ["collect", "--help"],
        ["collect", "plan", str(file)],
        ["collect", "plan", str(file), "--json"],
        ["config", "check", str(file)],
    ):
        result = run(*command)
        assert result.out + result.err, command
        told.append(result.out + result.err)
    has_ended = threading.Event()

    def end_when_both_sinks_are_down() -> None:
        said = [f"sink {name} is down" for name in ("broker", "history")]
        wait_until(lambda: has_ended.is_set() or all(text in caplog.text for text in said))
        if not has_ended.is_set():
            os.kill(os.getpid(), signal.SIGTERM)

    ending = threading.Thread(target=end_when_both_sinks_are_down)
    ending.start()
    try:
        result = run("collect", str(file), "-vvv", "--status-every", "100ms")
    finally:
        has_ended.set()
        ending.join()
    assert "sink broker: 0 samples sent" in result.out
    told += [result.out, result.err, caplog.text]
    secret.chmod(0o644)
    refused = run("collect", str(file))
    assert "can be read by others" in refused.err
    told.append(refused.err)
    assert not [text for text in told for secret in SECRETS.values() if secret in text]
