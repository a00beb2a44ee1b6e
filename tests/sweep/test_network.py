"""Two nodes in two network namespaces, and the cable between them pulled: nothing is lost, and the sweep says what happened.

Slow, and for root with network namespaces only (`tests/support/needs.py`): a Ray head and a second node, each with an address
of its own, a token that both know, and a pair of virtual cards between them.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from disturbed import SLOW, SWEEP, environment, finish, receipts, same_rows, start, wait_for
from fake_bench import workers
from needs import needs

from r2h_batch.sweep import cluster

pytestmark = needs("ray")

PORT, HEAD, NODE = 6391, "10.99.7.1", "10.99.7.2"


@pytest.fixture(autouse=True)
def no_token(monkeypatch):
    """No token in the environment; what `reach` sets there is taken back."""
    for key in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.setenv(key, "")
        monkeypatch.delenv(key)


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@pytest.fixture
def nodes(tmp_path):
    """The commands' environment, with a head of one CPU in one namespace and a node of one CPU in another."""
    names = {HEAD: f"r2h-{os.getpid()}-a", NODE: f"r2h-{os.getpid()}-b"}
    (tmp_path / "token").write_text("0123456789abcdef" * 4)
    env = environment(tmp_path, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN_PATH=str(tmp_path / "token"), FAKE_SECONDS="1")
    checks = {"period_ms": "500", "timeout_ms": "1000", "failure_threshold": "3", "initial_delay_ms": "1000"}
    env |= {f"RAY_health_check_{k}": v for k, v in checks.items()}
    ray, started = [str(Path(sys.executable).parent / "ray"), "start", "--num-cpus", "1", "--block"], []
    try:
        for name in names.values():
            ip("netns", "add", name)
        ip("link", "add", "r2h0", "netns", names[HEAD], "type", "veth", "peer", "name", "r2h0", "netns", names[NODE])
        for address, name in names.items():
            ip("-n", name, "addr", "add", f"{address}/24", "dev", "r2h0")
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "link", "set", "r2h0", "up")
        for address, role in (
            (HEAD, ["--head", "--port", str(PORT), "--include-dashboard", "false"]),
            (NODE, ["--address", f"{HEAD}:{PORT}"]),
        ):
            line = ["ip", "netns", "exec", names[address], *ray, "--node-ip-address", address, *role]
            with (tmp_path / f"{address}.log").open("w") as log:
                started.append(subprocess.Popen(line, stdout=log, stderr=log, env=env, start_new_session=True))
            wait_for(lambda log=log: "Ray runtime started" in Path(log.name).read_text(), address)
        yield names, env
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for name in names.values():
            for pid in subprocess.run(["ip", "netns", "pids", name], capture_output=True, text=True).stdout.split():
                os.kill(int(pid), signal.SIGKILL)
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


def sweep_in(namespace, env, out):
    line = ["ip", "netns", "exec", namespace, *SWEEP, "--method", SLOW, "--out", str(out), "--format", "csv"]
    line += ["--engine", "ray", "--workers", "2", "--address", f"{HEAD}:{PORT}", "--ray-timeout", "20"]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)


@pytest.mark.slow
@needs("netns")
@pytest.mark.parametrize("driver", [HEAD, NODE], ids=["beside the head", "cut off from the head"])
def test_the_network_is_cut_between_two_nodes(tmp_path, undisturbed, nodes, driver):
    names, env = nodes
    out, log = tmp_path / "run", tmp_path / "log"
    sweep = sweep_in(names[driver], env, out)
    wait_for(lambda: len(workers(log)) == 2 and len(receipts(out)) >= 2, "both nodes at work", 240)
    ip("-n", names[HEAD], "link", "set", "r2h0", "down")
    cut = time.monotonic()
    code, table, error = finish(sweep, timeout=240)
    if driver == HEAD:  # the node's shards go to the head's worker
        assert code == 0 and table.startswith("split,"), error
    else:
        assert code == 1 and table == "" and time.monotonic() - cut < 60, error
        said = [line for line in error.splitlines() if line.startswith("sweep: ")]
        assert len(said) == 1 and f"{HEAD}:{PORT} has not answered for 20 s (--ray-timeout)" in said[0], error
        assert "writing the run folder" not in error and "Traceback" not in error
        stored = len(receipts(out))
        assert 2 <= stored < 12
        code, table, error = finish(start(tmp_path, out, FAKE_SECONDS="0"))
        assert code == 0, error
    same_rows(out, undisturbed)


def test_a_cluster_that_asks_for_another_token_is_one_line_at_once(tmp_path, monkeypatch):
    """Ray repeats what the cluster says until its own time limit: a stand-in for it says it once and waits."""
    words = "gcs_client.cc:210: Unauthenticated: RPC error: InvalidAuthToken: Authentication token is missing"
    (tmp_path / "connect.py").write_text(f"import sys, time; print({words!r}, file=sys.stderr); time.sleep(60)")
    monkeypatch.setattr(cluster, "CONNECT", tmp_path / "connect.py")
    start_s = time.monotonic()
    with pytest.raises(cluster.ClusterError, match=r"asks for another token .* RAY_AUTH_MODE=token") as error:
        cluster.reach("10.0.0.1:6379", 30.0)
    assert time.monotonic() - start_s < 20 and "\n" not in str(error.value)


@pytest.mark.parametrize(("set_", "mode"), [({}, None), ({"RAY_AUTH_TOKEN": "a"}, "token")])
def test_a_token_that_is_there_is_shown_and_a_mode_that_is_set_is_left_alone(tmp_path, monkeypatch, set_, mode):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(cluster, "CONNECT", os.devnull)
    for key, value in set_.items():
        monkeypatch.setenv(key, value)
    cluster.reach("10.0.0.1:6379", 30.0)
    assert os.environ.get("RAY_AUTH_MODE") == mode
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    cluster.reach("10.0.0.1:6379", 30.0)
    assert os.environ["RAY_AUTH_MODE"] == "disabled"


def test_a_head_that_takes_no_connection_any_more_is_told_from_one_that_does(monkeypatch):
    monkeypatch.setattr(cluster, "HEAD_EVERY_S", 0.05)
    ends = []
    monkeypatch.setattr(cluster, "GRACE_S", 0.05)
    monkeypatch.setattr(cluster.os, "_exit", ends.append)
    with socket.create_server(("127.0.0.1", 0), backlog=64) as server:
        head = cluster.Head(f"127.0.0.1:{server.getsockname()[1]}", 0.3)
        time.sleep(0.8)
        head.check()
    wait_for(lambda: head.lost, "the loss", 20)
    with pytest.raises(cluster.ClusterError, match=r"has not answered for 0\.3 s"):
        head.check()
    wait_for(lambda: ends, "the end", 20)
    assert ends == [1]
    cluster.Head("", 0.0).check()
