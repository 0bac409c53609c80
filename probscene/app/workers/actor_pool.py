"""Actors on the nodes of a Ray cluster, and how they share tasks when some are late or lost."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from probscene.errors import MachineError, ProbsceneError

from .actor import Actor, versions

MIN_LATE_SECONDS = 20.0  # a task is late after so long, and after
LATE_FACTOR = 4.0  # times the longest task before it; then another actor is given it as well
NODE_POLL_SECONDS = 2.0
START_TIMEOUT = 180.0  # seconds until the first actor answers
MAX_ACTOR_DEATHS = 3  # on one task, before it is an error
RESULT_POLL_SECONDS = 0.5
CLOSE_TIMEOUT = 5.0  # seconds in which an actor ends its generators
SHARED_PATHS = "Nodes have to see the run's folder, its files and --out by the same paths as this machine."


@dataclass(eq=False)
class Worker:
    """An actor.

    Attributes:
        handle: Ray's handle of the actor.
        node: the id of its node.
        answer: the reference to its pending result; None where it is idle.
        request: what it was asked for: "versions", "prepare", or the number of a task.
        run: the number of the pool's run in which it was asked.
        since: when it was asked, seconds of the monotonic clock.
        late: whether its task was given to another worker as well.
    """

    handle: Any
    node: str
    answer: Any = None
    request: str | int = ""
    run: int = 0
    since: float = 0.0
    late: bool = False


class ActorPool:
    """Actors of one kind on all nodes of a cluster; see ``Cluster.actor_pool``.

    Args:
        ray: the module, connected to the cluster.
        address: of the cluster, for messages.
        callback: called with a message for each node that is lost or frozen.
        prepare: a module's function; called once an actor, it returns what does a task.
        arguments: of ``prepare``.
        threads: of torch in each actor, and cores that it takes.
    """

    def __init__(
        self,
        ray: ModuleType,
        address: str,
        callback: Callable[[str], None],
        prepare: Callable,
        arguments: tuple,
        threads: int,
    ):
        self.ray, self.address, self.callback, self.threads = ray, address, callback, threads
        self._preparation = prepare, arguments, threads
        self._remote = ray.remote(Actor)
        self._members: list[Worker] = []
        self._names: dict[str, str] = {}  # of the nodes with actors
        self._silent: set[str] = set()  # nodes that were reported as not answering
        self._polled, self._longest, self._runs = -NODE_POLL_SECONDS, 0.0, 0

    def run(self, tasks: Iterable[Any], done: Callable[[Any], None]) -> None:
        """Do tasks; ``done`` is called here with each result, in the order they come.

        Raises:
            ProbsceneError: the first that an actor raised, or nodes have other versions of what decides over bytes.
            MachineError: no node is left, or none has cores for an actor; actors died with a task too often.
        """
        tasks = list(tasks)
        self._runs += 1
        todo, finished, deaths = deque(range(len(tasks))), set(), Counter()
        start = time.monotonic()

        def requeue(member: Worker) -> None:
            """Give a member's task to another."""
            task = member.request
            if isinstance(task, int) and member.run == self._runs and task not in finished and task not in todo:
                todo.appendleft(task)

        while len(finished) < len(tasks):
            for member in self._update_nodes(max_workers=len(tasks)):
                requeue(member)
            for member in self._members:
                if member.answer is None and todo:
                    task = todo.popleft()
                    self._ask(member, task, member.handle.do.remote(tasks[task]))
            waited = {member.answer: member for member in self._members if member.answer is not None}
            if waited:
                ready, _ = self.ray.wait(list(waited), timeout=RESULT_POLL_SECONDS)
            else:
                ready = []
                time.sleep(RESULT_POLL_SECONDS)
            for answer in ready:
                member, task = waited[answer], waited[answer].request
                value = self._value(member)
                if value is None:  # it has died
                    requeue(member)
                    deaths[task] += 1
                    self._check_deaths(deaths[task], task)
                elif isinstance(task, int):
                    self._longest = max(self._longest, 0.0 if member.late else time.monotonic() - member.since)
                    if member.run == self._runs and task not in finished:
                        finished.add(task)
                        todo = deque(other for other in todo if other != task)
                        done(value[0])
                    member.late = False
                    self._silent.discard(member.node)
            if self._longest:
                for member in self._overdue():
                    requeue(member)
            if not self._longest and time.monotonic() - start > START_TIMEOUT and not self.any_answered():
                raise MachineError(
                    f"expected an actor on the cluster at {self.address} within {START_TIMEOUT:g} s, got none; "
                    "most often other jobs hold its cores. Wait for them, or add nodes."
                )

    def close(self) -> None:
        """End the actors; idle ones remove their files first."""
        idle = [member.handle.close.remote() for member in self._members if member.answer is None]
        if idle:
            self.ray.wait(idle, num_returns=len(idle), timeout=CLOSE_TIMEOUT)
        for member in self._members:
            self.ray.kill(member.handle, no_restart=True)
        self._members.clear()

    def _update_nodes(self, max_workers: int) -> list[Worker]:
        """Start actors where there are cores for more, up to ``max_workers`` at work.

        Returns:
            The workers that were lost with their nodes.
        """
        if time.monotonic() - self._polled < NODE_POLL_SECONDS:
            return []
        self._polled = time.monotonic()
        nodes = {node["NodeID"]: node for node in self.ray.nodes() if node["Alive"]}
        lost = [member for member in self._members if member.node not in nodes]
        for node in self._names.keys() - nodes:
            name = self._names.pop(node)
            if node not in self._silent:
                self.callback(f"Note: node {name} of the cluster is lost; others do its work.")
        self._members = [member for member in self._members if member not in lost]
        slots = {id: int(node["Resources"].get("CPU", 0) // self.threads) for id, node in nodes.items()}
        if not any(slots.values()):
            nodes_left = f"{len(nodes)} with fewer" if nodes else "none left"
            raise MachineError(
                f"expected a node with {self.threads} cores for an actor in the cluster at {self.address}, "
                f"got {nodes_left}. Start nodes, or ask for fewer --threads; the same command "
                "continues where it stopped."
            )
        for rank in range(max(slots.values())):
            for node, number in slots.items():
                started = sum(member.node == node for member in self._members)
                working = sum(not member.late for member in self._members)
                if rank < number and started <= rank and working < max_workers:
                    self._names[node] = nodes[node]["NodeManagerHostname"]
                    self._start(node)
        return lost

    def _start(self, node: str) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        on_node = NodeAffinitySchedulingStrategy(node, soft=False)
        handle = self._remote.options(num_cpus=self.threads, scheduling_strategy=on_node).remote()
        member = Worker(handle, node)
        self._ask(member, "versions", handle.versions.remote())
        self._members.append(member)

    def _ask(self, member: Worker, request: str | int, answer: Any) -> None:
        member.request, member.answer, member.run, member.since = request, answer, self._runs, time.monotonic()

    def _value(self, member: Worker) -> tuple[Any] | None:
        """What a member has answered; None where it has died, and is removed.

        Raises:
            ProbsceneError: the member raised it, or has other versions.
        """
        request, answer, member.answer = member.request, member.answer, None
        try:
            result = self.ray.get(answer)
        except self.ray.exceptions.RayError as error:
            self._members.remove(member)
            if "No module named" in str(error):
                raise MachineError(
                    f"expected probscene {versions()['probscene']} on node {self._names[member.node]}, got "
                    f"{first_line(error, 'No module named')}; install it in the environment that Ray runs in there."
                ) from error
            return None
        kind, value = result
        if kind == "fault":
            where = f"On node {self._names[member.node]}: "
            shared = f" {SHARED_PATHS}" if request == "prepare" else ""
            raise type(value)(f"{where}{value}{shared}") if isinstance(value, ProbsceneError) else value
        if request == "versions":
            self._check_versions(member, value)
            self._ask(member, "prepare", member.handle.prepare.remote(*self._preparation))
            return (None,)
        return (value,)

    def _check_versions(self, member: Worker, remote: dict[str, str]) -> None:
        local = versions()
        if other := [name for name in local if local[name] != remote.get(name)]:
            raise ProbsceneError(
                f"expected {', '.join(f'{name} {local[name]}' for name in other)} on node {self._names[member.node]}, "
                f"as on this machine, got {', '.join(str(remote.get(name)) for name in other)}; other versions may "
                "give other bytes. Install the same on all nodes."
            )

    def _check_deaths(self, number: int, task: str | int) -> None:
        if number >= MAX_ACTOR_DEATHS and task != "versions":
            raise MachineError(
                f"expected an actor to do its task, got {number} actors that died with the same one, most often for "
                "lack of memory. Run the same command again: it continues where it stopped; nodes with fewer CPUs "
                "(ray start --num-cpus) run fewer actors."
            )

    def _overdue(self) -> list[Worker]:
        """Members whose tasks are late, each listed once a task."""
        limit, now = max(MIN_LATE_SECONDS, LATE_FACTOR * self._longest), time.monotonic()
        late = []
        for member in self._members:
            busy = isinstance(member.request, int) and member.answer is not None and not member.late
            if busy and now - member.since > limit:
                member.late = True
                late.append(member)
        for node in {member.node for member in late} - self._silent:
            if all(member.late for member in self._members if member.node == node):
                self._silent.add(node)
                self.callback(
                    f"Note: node {self._names[node]} of the cluster has not answered for {limit:.0f} s; others do its "
                    "work, too."
                )
        return late

    def any_answered(self) -> bool:
        """Whether an actor has answered; preparing may take long where its cores are busy."""
        return any(member.request != "versions" or member.answer is None for member in self._members)


def first_line(error: Exception, word: str = "") -> str:
    """The first line of an error's message that holds a word."""
    lines = [line.strip() for line in str(error).splitlines() if word in line and line.strip()]
    return lines[0].rstrip(".") if lines else type(error).__name__
