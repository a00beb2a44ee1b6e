"""The Ray engine: any workers give the rows of one process, whatever dies on the way."""

import io
import os
import signal
import socket
import threading
import time
from collections import deque
from types import SimpleNamespace

import pytest
from alive import alive, all_end
from disturbed import DEADLY, SLOW, finish, same_rows, start, stored_shards, wait_for
from fake_bench import workers
from needs import needs

from r2h_batch.runs import store
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import cluster

pytestmark = [needs("ray"), pytest.mark.alone]


RAY = ("--engine", "ray", "--workers", "2")
ONE = ("--engine", "ray", "--workers", "1")


def test_a_killed_worker_is_replaced_the_digest_is_that_of_one_process_and_a_finished_run_starts_none(
    tmp_path, undisturbed
):
    out, log = tmp_path / "run", tmp_path / "log"
    sweep = start(tmp_path, out, SLOW, *ONE, FAKE_WORKERS="2", fork=True)
    wait_for(lambda: len(stored_shards(out)) >= 2, "two shards")
    os.kill(int(log.read_text().splitlines()[-1].split()[0]), signal.SIGKILL)
    code, table, error = finish(sweep)
    assert code == 0 and table.startswith("split,"), error
    assert "a worker died at shard" in error and "the sweep goes on" in error
    assert len(workers(log)) == 2
    same_rows(out, undisturbed)
    code, again, error = finish(start(tmp_path, out, SLOW, *ONE, fork=True))
    assert code == 0 and again == table, error
    assert len(workers(log)) == 2


def test_who_died_is_told_from_the_words_of_ray():
    node = (
        "The actor died unexpectedly before finishing this task. The actor died because its node has died. Node Id: c9"
    )
    worker = "The actor is dead because its worker process has died. Worker exit type: SYSTEM_ERROR"

    def died(words, before, after):
        nodes = [{"Alive": k < after} for k in range(3)]
        return cluster._died(Exception(words), SimpleNamespace(nodes=before, ray=SimpleNamespace(nodes=lambda: nodes)))

    assert died(node, 2, 2) == died(worker, 3, 2) == "a node of the cluster died, and its workers with it"
    assert died(worker, 2, 2) == died(worker, 1, 2) == "a worker died"
    with pytest.raises(cluster.ClusterError, match="the last node of the Ray cluster died"):
        died(worker, 1, 0)


def test_what_threads_of_ray_print_is_not_the_sweeps():
    kept = io.StringIO()
    stream = cluster.NotOfRay(kept)
    for name in ("ray_print_logs", "of the sweep"):
        thread = threading.Thread(target=print, args=(name,), kwargs={"file": stream}, name=name)
        thread.start()
        thread.join()
    assert kept.getvalue() == "of the sweep\n" and stream.isatty() is False


def test_a_worker_whose_method_has_other_files_is_refused():
    answer = {"sources": {"mine": {"sha256": "b"}}}
    ray = SimpleNamespace(get=lambda _: answer, exceptions=SimpleNamespace(RayError=OSError))
    pool = cluster.Pool(ray, lambda: None, starting={0: "actor"})
    with pytest.raises(cluster.ClusterError, match="a Ray worker has another mine"):
        job = SimpleNamespace(name="mine", source={"sha256": "a"})
        cluster._came_up(pool, 0, SimpleNamespace(setting=SimpleNamespace(header={}), jobs=[job]))


def test_a_cluster_that_breaks_off_is_no_trouble_of_the_run_folder(tmp_path):
    """A killed raylet: whichever of Ray's calls comes next raises an OSError without a number."""

    def broken(*_, **__):
        raise OSError("Broken pipe")

    ray = SimpleNamespace(wait=broken, kill=broken, exceptions=SimpleNamespace(RayError=KeyError))
    pool = cluster.Pool(ray, lambda: SimpleNamespace(header=SimpleNamespace(remote=object)))
    todo = deque([("mine", store.Shard(0, 0, 10))])
    with pytest.raises(
        cluster.ClusterError, match=r"does not answer any more .Broken pipe.*the same command continues"
    ):
        cluster._feed(pool, 1, todo, SimpleNamespace(stopping=lambda: False), print)
    pool.stop()


@pytest.mark.slow
def test_kill_9_of_the_driver_leaves_a_folder_that_goes_on(tmp_path, undisturbed):
    out = tmp_path / "run"
    sweep = start(tmp_path, out, SLOW, *RAY, FAKE_SECONDS="0.2")
    wait_for(lambda: len(stored_shards(out)) >= 3, "three shards")
    children = [int(line.split()[0]) for line in (tmp_path / "log").read_text().splitlines()]
    assert any(map(alive, children))
    sweep.kill()
    finish(sweep)
    assert all_end(children, 60)
    stored = stored_shards(out)
    assert len(stored) < 12
    times = [p.stat().st_mtime_ns for p in stored]
    code, _, error = finish(start(tmp_path, out, SLOW, *RAY, FAKE_SECONDS="0"))
    assert code == 0, error
    assert [p.stat().st_mtime_ns for p in stored] == times
    same_rows(out, undisturbed)


@pytest.mark.slow
def test_two_sweeps_on_ray_in_one_folder_share_its_shards(tmp_path, undisturbed):
    out, log = tmp_path / "run", tmp_path / "log"
    sweeps = [start(tmp_path, out, SLOW, *ONE, FAKE_SECONDS="0.2") for _ in range(2)]
    for code, table, error in map(finish, sweeps):
        assert code == 0 and table.startswith("split,"), error
    assert len(workers(log)) == 2
    same_rows(out, undisturbed)


@pytest.mark.slow
def test_a_shard_that_always_kills_its_worker_is_left_out_named_and_tried_again_on_resume(tmp_path, undisturbed):
    out, log = tmp_path / "run", tmp_path / "log"
    code, table, error = finish(start(tmp_path, out, DEADLY, *ONE, FAKE_DEADLY="47"))
    assert code == 1 and table == "", error
    assert f"{DEADLY}: left out after three tries: shards 4 (the last: " in error
    assert log.read_text() == "x" * 3 and len(stored_shards(out)) == 11
    run = load_run(out)
    assert [s.index for s in run.missing(DEADLY)] == [4]
    code, table, error = finish(start(tmp_path, out, DEADLY, FAKE_DEADLY="-1"))
    assert code == 0 and table.startswith("split,"), error
    same_rows(out, undisturbed, DEADLY)


@pytest.mark.slow
def test_kill_9_of_a_second_node_moves_its_shards_to_the_first(tmp_path, undisturbed, monkeypatch):
    from disturbed import environment
    from ray.cluster_utils import Cluster

    for key, value in environment(tmp_path).items():
        monkeypatch.setenv(key, value)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        out, log = tmp_path / "run", tmp_path / "log"
        sweep = start(tmp_path, out, SLOW, *RAY, "--address", cluster.address, FAKE_SECONDS="0.3")
        wait_for(lambda: len(workers(log)) == 2 and len(stored_shards(out)) >= 2, "both nodes at work")
        for processes in node.all_processes.values():
            for process in processes:
                os.kill(process.process.pid, signal.SIGKILL)
        time.sleep(0.1)
        code, table, error = finish(sweep, timeout=150)
        assert code == 0 and table.startswith("split,"), error
        same_rows(out, undisturbed)
    finally:
        cluster.shutdown()


@pytest.mark.slow
def test_without_an_address_a_cluster_of_its_own_is_started_and_a_refused_method_stops_no_other(tmp_path, undisturbed):
    """Whatever the environment names; a method whose answers cannot be scored is said once, and is not tried again."""
    out = tmp_path / "run"
    both = ("fake_bench:wrong", SLOW)
    around = {"RAY_ADDRESS": "192.0.2.1:6379", "HOME": str(tmp_path / "home")}
    code, table, error = finish(start(tmp_path, out, both, *RAY, **around, FAKE_SECONDS="0"))
    assert not (tmp_path / "home" / ".ray").exists()  # no token that later clusters of this user would ask for
    assert code == 2 and SLOW in table and "fake_bench:wrong" not in table, error
    said = [line for line in error.splitlines() if line.startswith("sweep: ")]
    assert len(said) == 1 and said[0].startswith("sweep: method fake_bench:wrong: T_obj_ee is"), error
    assert "Traceback" not in error
    same_rows(out, undisturbed)


def test_a_cluster_that_does_not_answer_is_one_line_after_the_time_limit(tmp_path):
    out = tmp_path / "run"
    with socket.create_server(("127.0.0.1", 0)) as deaf:  # takes connections and says nothing
        address = f"127.0.0.1:{deaf.getsockname()[1]}"
        code, table, error = finish(
            start(tmp_path, out, SLOW, *RAY, "--address", address, "--ray-timeout", "6", fork=True)
        )
    assert code == 2 and table == "" and error.count("\n") == 1, error
    assert error.startswith("sweep: no Ray cluster") and address in error and "writing the run folder" not in error
    assert not out.exists()
