"""Faults between machines: two servers, two workers, a PostgreSQL and an S3 server in a network of their own (namespaces of this
machine), while jobs, streams and questions go on.

    network_faults.py PROGRAM DIR [--minutes 15]

PROGRAM has the feature `cloud`. Needs root, PostgreSQL, moto's S3 server in PATH, and libfaketime. In turn: delays, lost packets, cuts
between each two kinds of machines, a slow object store, a database that only reads, clocks that are wrong. Afterwards everything that
was acknowledged must be there: each job has succeeded once, each data set has the bytes of an undisturbed one and can be read from
both servers, equal trainings have equal weights, and no stream has lost a frame. A server may say "later" (429, 503), nothing worse.
"""

import argparse
import asyncio
import collections
import glob
import hashlib
import itertools
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import httpx

import failover
import foreframe
from machines import HERE, PERFECT, Link, Network

ROOT = Path(__file__).parents[2]
SERVERS, WORKERS, DATABASE, OBJECTS = ["server-a", "server-b"], ["worker-a", "worker-b"], "database", "objects"
#: The machine whose clock goes wrong.
SKEWED = ["server-b", "worker-b"]
PORT, OBJECTS_PORT = 8642, 9000
LEASE_S = 4
#: Longer than a statement may wait for the database.
ANSWER_LIMIT_S = 30.0
TRAINING = {
    "model": {"features": 16, "hidden": 16},
    "data": {"windows": 32, "validation_windows": 4},
    "pretrain": {"steps": 0, "start": "random"},
    "sequence": {"steps": 24, "batch_size": 8},
    "run": {"validate_every_steps": 8, "checkpoint_every_steps": 4},
}


class Topology:
    """All machines and their programs."""

    def __init__(self, network: Network, program: str, directory: Path) -> None:
        self.network, self.program, self.directory = network, program, directory
        self.processes: dict[str, subprocess.Popen] = {}
        self.key = ""
        self._postgres = max(glob.glob("/usr/lib/postgresql/*/bin/pg_ctl"), default="")
        assert self._postgres, "PostgreSQL is not installed"
        self._faketime = next(iter(glob.glob("/usr/lib/*/faketime/libfaketime.so.1")), None)
        assert self._faketime, "libfaketime is not installed (Debian: apt-get install faketime)"

    def start(self) -> None:
        self._start_database()
        self._run(OBJECTS, [shutil.which("moto_server"), "-H", self.network.address(OBJECTS), "-p", str(OBJECTS_PORT)])
        bucket = f"http://{self.network.address(OBJECTS)}:{OBJECTS_PORT}/foreframe"
        _until(lambda: httpx.put(bucket).status_code == 200)
        command = [self.program, "keys", "create", "robot", "--data-dir", str(self.directory / "keys")]
        made = subprocess.run(self.network.inside(SERVERS[0], command), check=True, env=self._environment(), stdout=subprocess.PIPE, text=True)
        self.key = made.stdout.strip()
        for name in SERVERS:
            bind = f"{self.network.address(name)}:{PORT}"
            self._run(name, [self.program, "serve", "--bind", bind, "--run-jobs", "false", *self._settings(name)])
            _until(lambda: httpx.get(f"{self.url(name)}/readyz").status_code == 200)
        for name in WORKERS:
            self._run(name, [self.program, "worker", *self._settings(name)])

    def stop(self) -> None:
        for process in self.processes.values():
            process.send_signal(signal.SIGTERM)
        for process in self.processes.values():
            process.wait()
        self._pg_ctl("-m", "immediate", "stop")

    def url(self, server: str) -> str:
        return f"http://{self.network.address(server)}:{PORT}"

    def all_run(self) -> bool:
        return all(process.poll() is None for process in self.processes.values())

    def set_clock(self, name: str, offset_s: int) -> None:
        """By how much a machine's clock is wrong from now on."""
        (self.directory / f"{name}.clock").write_text(f"{offset_s:+d}\n")

    def set_read_only(self, is_read_only: bool) -> None:
        """As a replica that has not taken over yet."""
        psql = ["psql", "-h", str(self.directory / "postgres"), "-U", "foreframe", "postgres", "-q"]
        for statement in (f"ALTER SYSTEM SET default_transaction_read_only = {is_read_only}", "SELECT pg_reload_conf()"):
            # What is asked here may write all the same.
            environment = {**os.environ, "PGOPTIONS": "-c default_transaction_read_only=off"}
            subprocess.run([*psql, "-c", statement], check=True, env=environment, stdout=subprocess.DEVNULL)

    def _settings(self, name: str) -> list[str]:
        settings = {"admin_bind": "off", "job_lease_ms": LEASE_S * 1000, "max_queued_jobs": 64}
        return ["--data-dir", str(self.directory / name), *itertools.chain(*(["--set", f"{k}={v}"] for k, v in settings.items()))]

    def _environment(self) -> dict[str, str]:
        return {
            **os.environ,
            "FOREFRAME_DATABASE_URL": f"postgres://foreframe@{self.network.address(DATABASE)}/postgres",
            "FOREFRAME_OBJECTS_URL": "s3://foreframe",
            "FOREFRAME_MODELS_DIR": str(ROOT / "models"),
            "AWS_ENDPOINT_URL": f"http://{self.network.address(OBJECTS)}:{OBJECTS_PORT}",
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
        }

    def _run(self, name: str, command: list[str]) -> None:
        environment = self._environment()
        if name in SKEWED:
            self.set_clock(name, 0)
            clock = self.directory / f"{name}.clock"
            # Time since the start of the machine stays right, as it does on a machine whose clock is set.
            environment |= {
                "LD_PRELOAD": self._faketime,
                "FAKETIME_TIMESTAMP_FILE": str(clock),
                "FAKETIME_CACHE_DURATION": "1",
                "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            }
        with (self.directory / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                self.network.inside(name, command), env=environment, stdout=log, stderr=subprocess.STDOUT
            )

    def _start_database(self) -> None:
        place = self.directory / "postgres"
        place.mkdir()
        shutil.chown(place, "postgres")
        self._as_postgres([str(Path(self._postgres).with_name("initdb")), "-D", str(place / "data"), "-U", "foreframe", "-A", "trust", "--no-sync"])
        with (place / "data/pg_hba.conf").open("a") as access:
            access.write("host all all 198.18.0.0/24 trust\n")
        options = f"-k {place} -c listen_addresses={self.network.address(DATABASE)} -c fsync=off"
        self._pg_ctl("-l", str(place / "log"), "-o", options, "-w", "start")

    def _pg_ctl(self, *arguments: str) -> None:
        self._as_postgres([self._postgres, "-D", str(self.directory / "postgres/data"), *arguments])

    def _as_postgres(self, command: list[str]) -> None:
        # PostgreSQL refuses to be run by root.
        inside = self.network.inside(DATABASE, ["runuser", "-u", "postgres", "--", *command])
        subprocess.run(inside, check=True, cwd="/", stdout=subprocess.DEVNULL)


@dataclass
class Fault:
    name: str
    begin: Callable[[Topology], None]
    end: Callable[[Topology], None] = lambda topology: topology.network.set_all(PERFECT)

    @classmethod
    def between(cls, name: str, ones: list[str], others: list[str], link: Link) -> "Fault":
        def begin(topology: Topology) -> None:
            for one, other in itertools.product(ones, others):
                topology.network.set(one, other, link)

        return cls(name, begin)


CUT = Link(is_cut=True)
FAULTS = [
    Fault("200 ms between all machines", lambda topology: topology.network.set_all(Link(delay_s=0.2))),
    Fault("5 % of all packets lost", lambda topology: topology.network.set_all(Link(loss=0.05))),
    Fault.between("server-a without the database", ["server-a"], [DATABASE], CUT),
    Fault.between("worker-a without the database", ["worker-a"], [DATABASE], CUT),
    Fault.between("nobody reaches the database", [*SERVERS, *WORKERS], [DATABASE], CUT),
    Fault.between("nobody reaches the object store", [*SERVERS, *WORKERS], [OBJECTS], CUT),
    Fault.between("a slow object store", [*SERVERS, *WORKERS], [OBJECTS], Link(delay_s=1.0, bytes_per_s=50_000)),
    Fault("the database only reads", lambda topology: topology.set_read_only(True), lambda topology: topology.set_read_only(False)),
    Fault("clocks 10 minutes fast", lambda topology: _set_clocks(topology, 600), lambda topology: _set_clocks(topology, 0)),
    Fault("clocks 10 minutes slow", lambda topology: _set_clocks(topology, -600), lambda topology: _set_clocks(topology, 0)),
    Fault.between("the client without server-a", [HERE], ["server-a"], CUT),
]


@dataclass
class Seen:
    """What was acknowledged and answered."""

    #: What each job was asked to do, by its id.
    jobs: dict[str, dict] = field(default_factory=dict)
    answers: collections.Counter = field(default_factory=collections.Counter)
    longest_s: float = 0.0
    later: collections.Counter = field(default_factory=collections.Counter)


def _set_clocks(topology: Topology, offset_s: int) -> None:
    for name in SKEWED:
        topology.set_clock(name, offset_s)


def _until(is_there: Callable[[], bool], limit_s: float = 60.0) -> None:
    end_s = time.monotonic() + limit_s
    while True:
        try:
            if is_there():
                return
        except httpx.TransportError:
            pass
        assert time.monotonic() < end_s, "a program did not start; see its log"
        time.sleep(0.1)


def specs():
    """Jobs, without end: collections of few seeds, whole and in parts, and one training again and again."""
    for number in itertools.count():
        collect = {"kind": "collect", "name": f"set-{number}", "scenario": "static-observer", "trials": 6, "seed": number % 2}
        yield [collect, {**collect, "parts": 2}, {"kind": "train", "name": f"m-{number}", "preset": "paper", "dataset": "seen", "settings": TRAINING}][
            number % 3
        ]


async def submit(client: foreframe.AsyncClient, spec: dict, number: int, seen: Seen) -> None:
    """Asks until the job is acknowledged, as a client does that does not know whether its request arrived."""
    while True:
        try:
            job = await client.submit(spec, idempotency_key=f"network-faults-{number}")
        except foreframe.ApiError as error:
            assert error.status in (429, 503), f"job {spec}: {error}"
            seen.later[error.status] += 1
        except foreframe.ConnectionFailed:
            seen.later["no connection"] += 1
        else:
            assert job.id not in seen.jobs, f"{job.id} was acknowledged for {seen.jobs[job.id]} and for {spec}"
            seen.jobs[job.id] = spec
            return
        await asyncio.sleep(0.5)


async def submit_jobs(clients: list, every_s: float, seen: Seen, is_over: asyncio.Event) -> None:
    for number, spec in enumerate(specs()):
        if is_over.is_set():
            return
        await submit(clients[number % len(clients)], spec, number, seen)
        await asyncio.sleep(every_s)


async def ask(url: str, key: str, seen: Seen, is_over: asyncio.Event) -> None:
    """Reads again and again; counts how it was answered."""
    async with httpx.AsyncClient(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=ANSWER_LIMIT_S) as http:
        for path in itertools.cycle(["/v1/jobs", "/v1/models", "/v1/datasets", "/v1/datasets/seen/episodes/0/preview.png"]):
            if is_over.is_set():
                return
            started_s = time.monotonic()
            try:
                status = (await http.get(path)).status_code
            except httpx.ReadTimeout:
                status = "none in time"
            except httpx.TransportError:
                # The client may be cut off.
                status = "no connection"
            else:
                seen.longest_s = max(seen.longest_s, time.monotonic() - started_s)
            seen.answers[status] += 1
            assert status in (200, 429, 503, "no connection", "none in time"), f"GET {path}: {status}"
            await asyncio.sleep(0.2)


async def go_through_faults(topology: Topology, seconds: float) -> None:
    for fault in FAULTS:
        print(f"{time.strftime('%H:%M:%S')} {fault.name}", flush=True)
        fault.begin(topology)
        await asyncio.sleep(0.6 * seconds / len(FAULTS))
        fault.end(topology)
        await asyncio.sleep(0.4 * seconds / len(FAULTS))
        assert topology.all_run(), "a program has ended; see its log"


async def ended_jobs(client: foreframe.AsyncClient, seen: Seen, limit_s: float) -> dict:
    """All acknowledged jobs after they have ended."""
    end_s, jobs = time.monotonic() + limit_s, {}
    for job_id in seen.jobs:
        while not (job := await client.job(job_id)).is_over:
            assert time.monotonic() < end_s, f"{job_id} has not ended: {job}"
            await asyncio.sleep(0.5)
        jobs[job_id] = job
    return jobs


async def check(directory: Path, clients: list, jobs: dict, seen: Seen, undisturbed: dict) -> None:
    """Everything that was acknowledged is there, once, with the right bytes."""
    known = collections.Counter(job.spec.get("name") for job in await clients[0].jobs(limit=1000))
    weights = set()
    for job_id, spec in seen.jobs.items():
        job, name = jobs[job_id], spec["name"]
        assert job.state == "succeeded", f"{job_id}, {spec}: {job.state}, {job.error}"
        assert known[name] == 1, f"{known[name]} jobs have the name {name}"
        if spec["kind"] == "train":
            assert (await clients[1].model(name)).versions == (1,)
            copies = list(directory.glob(f"*/models/{name}/1/*.safetensors"))
            assert copies, f"no machine has the weights of {name}"
            weights |= {hashlib.sha256(copy.read_bytes()).hexdigest() for copy in copies}
            continue
        for client in clients:
            assert (await client.dataset(name)).content_hash == undisturbed[spec["seed"]], f"{name} has other bytes"
            preview = await client._http.get(f"/v1/datasets/{name}/episodes/0/preview.png")
            assert preview.status_code == 200, f"{name}: {preview.text}"
    assert len(weights) == 1, "equal trainings have different weights"
    kinds = collections.Counter(spec["kind"] for spec in seen.jobs.values())
    assert kinds["train"] >= 2, "too few jobs were tried"
    print(f"{len(jobs)} jobs acknowledged ({dict(kinds)}), all succeeded once, with the bytes of undisturbed ones")


async def collect_undisturbed(client: foreframe.AsyncClient) -> dict:
    """The content hash by seed, before anything fails."""
    hashes = {}
    for seed in (0, 1):
        name = f"undisturbed-{seed}"
        await client.wait(await client.submit({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 6, "seed": seed}))
        hashes[seed] = (await client.dataset(name)).content_hash
    return hashes


async def play(topology: Topology, arguments: argparse.Namespace) -> None:
    seconds, seen, is_over = 60.0 * arguments.minutes, Seen(), asyncio.Event()
    clients = [foreframe.AsyncClient(topology.url(name), key=topology.key, timeout_s=ANSWER_LIMIT_S) for name in SERVERS]
    await clients[0].wait(await clients[0].submit({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 12}))
    undisturbed = await collect_undisturbed(clients[0])
    drive = failover.Drive.example()
    expected = await failover.unbroken(clients[0], "moving", drive, 2 * len(drive.frames))
    tasks = [
        asyncio.create_task(submit_jobs(clients, max(5.0, seconds / 100), seen, is_over)),
        *(asyncio.create_task(ask(topology.url(name), topology.key, seen, is_over)) for name in SERVERS),
    ]
    streams = [
        asyncio.create_task(failover.follow(client, "moving", drive, expected, 0.2, 0.05 * number, is_over))
        for number, client in enumerate(2 * clients)
    ]
    faults = asyncio.create_task(go_through_faults(topology, seconds))
    done, _ = await asyncio.wait([faults, *tasks, *streams], return_when=asyncio.FIRST_COMPLETED)
    is_over.set()
    for task in done:
        task.result()
    await asyncio.gather(*tasks)
    frames = [outcome.answered for outcome in await asyncio.gather(*streams)]
    jobs = await ended_jobs(clients[0], seen, 120.0 + seconds / 5)
    await check(topology.directory, clients, jobs, seen, undisturbed)
    assert seen.longest_s > 2.0, "no question met a fault: the test tests nothing"
    print(f"answers to questions: {dict(seen.answers)}, the longest after {seen.longest_s:.1f} s; jobs to be asked for again: {dict(seen.later)}")
    print(f"{sum(frames)} frames of {len(frames)} streams answered, 0 lost, all as in an unbroken stream")
    for client in clients:
        await client.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("dir")
    parser.add_argument("--minutes", type=float, default=15.0)
    arguments = parser.parse_args()
    directory = Path(arguments.dir).resolve()
    directory.mkdir(parents=True)
    with Network([*SERVERS, *WORKERS, DATABASE, OBJECTS], "ff") as network:
        topology = Topology(network, arguments.program, directory)
        try:
            topology.start()
            asyncio.run(play(topology, arguments))
        finally:
            topology.stop()
    panics = [name for name in topology.processes if "panicked" in (directory / f"{name}.log").read_text(errors="replace")]
    assert not panics, f"panics in the logs of {panics}"


if __name__ == "__main__":
    main()
