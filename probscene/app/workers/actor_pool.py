"""Actors on the nodes of a Ray cluster, and how they share out tasks when some are late or gone."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from probscene.errors import MachineError, ProbsceneError

from .actor import Actor, versions

if TYPE_CHECKING:
    from .cluster import Cluster

LATE = 20.0  # seconds that a task may take at least, and
SLOWER = 4.0  # times the longest that has been done before: then another actor is given it, too
LOOK = 2.0  # seconds from one look at the nodes to the next
START = 180.0  # seconds in which the first actor has to be there
ATTEMPTS = 3  # actors that may die with a task before it is an error
WAIT = 0.5  # seconds
CLOSE = 5.0  # seconds in which an actor can put its things in order
SHARED = "Nodes have to see the run's folder, its files and --out by the same paths as this machine."


@dataclass(eq=False)
class Worker:
    """An actor.

    Attributes:
        handle: Ray's.
        node: its node's id.
        answer: the reference to what it is asked for; None where it has nothing to do.
        asked: what that is: "versions", "prepare", or the number of a task.
        run: in which of the crew's runs it was asked.
        since: when.
        late: whether its task was given to another as well.
    """

    handle: Any
    node: str
    answer: Any = None
    asked: str | int = ""
    run: int = 0
    since: float = 0.0
    late: bool = False


class ActorPool:
    """Actors of one kind on all nodes of a cluster; see ``Cluster.crew``."""

    def __init__(self, cluster: "Cluster", prepare: Callable, arguments: tuple, threads: int):
        self.cluster, self.ray, self.threads = cluster, cluster.ray, threads
        self._preparation = prepare, arguments, threads
        self._remote = self.ray.remote(Actor)
        self._members: list[Worker] = []
        self._names: dict[str, str] = {}  # of nodes that actors were started on
        self._silent: set[str] = set()  # nodes of which was said that they do not answer
        self._looked, self._longest, self._runs = -LOOK, 0.0, 0

    def run(self, tasks: Iterable[Any], done: Callable[[Any], None]) -> None:
        """Have tasks done; ``done`` is called here with each result, in the order they come.

        Raises:
            ProbsceneError: the first that an actor raised, or nodes have other versions of what decides over bytes.
            MachineError: no node is left, or none has cores for an actor; actors died with a task too often.
        """
        tasks = list(tasks)
        self._runs += 1
        todo, finished, deaths = deque(range(len(tasks))), set(), Counter()
        begun = time.monotonic()

        def again(member: Worker) -> None:
            """Let others do what a member was asked for."""
            task = member.asked
            if isinstance(task, int) and member.run == self._runs and task not in finished and task not in todo:
                todo.appendleft(task)

        while len(finished) < len(tasks):
            for member in self._lost(most=len(tasks)):
                again(member)
            for member in self._members:
                if member.answer is None and todo:
                    task = todo.popleft()
                    self._ask(member, task, member.handle.do.remote(tasks[task]))
            waited = {member.answer: member for member in self._members if member.answer is not None}
            if waited:
                ready, _ = self.ray.wait(list(waited), timeout=WAIT)
            else:
                ready = []
                time.sleep(WAIT)
            for answer in ready:
                member, task = waited[answer], waited[answer].asked
                value = self._value(member)
                if value is None:  # it has died
                    again(member)
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
                    again(member)
            if not self._longest and time.monotonic() - begun > START and not self._there():
                raise MachineError(
                    f"expected an actor on the cluster at {self.cluster.address} within {START:g} s, got none; "
                    "most often other jobs hold its cores. Wait for them, or add nodes."
                )

    def close(self) -> None:
        """End the actors; those that have nothing to do leave no files."""
        idle = [member.handle.close.remote() for member in self._members if member.answer is None]
        if idle:
            self.ray.wait(idle, num_returns=len(idle), timeout=CLOSE)
        for member in self._members:
            self.ray.kill(member.handle, no_restart=True)
        self._members.clear()

    def _lost(self, most: int) -> list[Worker]:
        """Start actors where there are cores for more, so that ``most`` are at work; those that have gone with their
        nodes."""
        if time.monotonic() - self._looked < LOOK:
            return []
        self._looked = time.monotonic()
        nodes = {node["NodeID"]: node for node in self.ray.nodes() if node["Alive"]}
        lost = [member for member in self._members if member.node not in nodes]
        for node in self._names.keys() - nodes:
            name = self._names.pop(node)
            if node not in self._silent:
                self.cluster.say(f"Note: node {name} of the cluster is lost; others do its work.")
        self._members = [member for member in self._members if member not in lost]
        room = {id: int(node["Resources"].get("CPU", 0) // self.threads) for id, node in nodes.items()}
        if not any(room.values()):
            there = f"{len(nodes)} with fewer" if nodes else "none left"
            raise MachineError(
                f"expected a node with {self.threads} cores for an actor in the cluster at {self.cluster.address}, "
                f"got {there}. Start nodes, or ask for fewer --threads; the same command goes on where it stopped."
            )
        for rank in range(max(room.values())):
            for node, number in room.items():
                there = sum(member.node == node for member in self._members)
                working = sum(not member.late for member in self._members)
                if rank < number and there <= rank and working < most:
                    self._names[node] = nodes[node]["NodeManagerHostname"]
                    self._start(node)
        return lost

    def _start(self, node: str) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        there = NodeAffinitySchedulingStrategy(node, soft=False)
        handle = self._remote.options(num_cpus=self.threads, scheduling_strategy=there).remote()
        member = Worker(handle, node)
        self._ask(member, "versions", handle.versions.remote())
        self._members.append(member)

    def _ask(self, member: Worker, what: str | int, answer: Any) -> None:
        member.asked, member.answer, member.run, member.since = what, answer, self._runs, time.monotonic()

    def _value(self, member: Worker) -> tuple[Any] | None:
        """What a member has answered; None where it has died, which is then no member any more.

        Raises:
            ProbsceneError: what it has raised; other versions.
        """
        asked, answer, member.answer = member.asked, member.answer, None
        try:
            found = self.ray.get(answer)
        except self.ray.exceptions.RayError as error:
            self._members.remove(member)
            if "No module named" in str(error):
                raise MachineError(
                    f"expected probscene {versions()['probscene']} on node {self._names[member.node]}, got "
                    f"{first_line(error, 'No module named')}; install it in the environment that Ray runs in there."
                ) from error
            return None
        if asked == "versions":
            self._check_versions(member, found)
            self._ask(member, "prepare", member.handle.prepare.remote(*self._preparation))
            return (None,)
        kind, value = found
        if kind == "fault":
            where = f"On node {self._names[member.node]}: "
            shared = f" {SHARED}" if asked == "prepare" else ""
            raise type(value)(f"{where}{value}{shared}") if isinstance(value, ProbsceneError) else value
        return (value,)

    def _check_versions(self, member: Worker, there: dict[str, str]) -> None:
        here = versions()
        if other := [name for name in here if here[name] != there.get(name)]:
            raise ProbsceneError(
                f"expected {', '.join(f'{name} {here[name]}' for name in other)} on node {self._names[member.node]}, "
                f"as on this machine, got {', '.join(str(there.get(name)) for name in other)}; other versions may "
                "give other bytes. Install the same on all nodes."
            )

    def _check_deaths(self, number: int, task: str | int) -> None:
        if number >= ATTEMPTS and task != "versions":
            raise MachineError(
                f"expected an actor to do its task, got {number} actors that died with the same one, most often for "
                "lack of memory. Run the same command again: it goes on where it stopped; nodes with fewer CPUs "
                "(ray start --num-cpus) run fewer actors."
            )

    def _overdue(self) -> list[Worker]:
        """Members whose tasks are late, each named once a task."""
        limit, now = max(LATE, SLOWER * self._longest), time.monotonic()
        found = []
        for member in self._members:
            busy = isinstance(member.asked, int) and member.answer is not None and not member.late
            if busy and now - member.since > limit:
                member.late = True
                found.append(member)
        for node in {member.node for member in found} - self._silent:
            if all(member.late for member in self._members if member.node == node):
                self._silent.add(node)
                self.cluster.say(
                    f"Note: node {self._names[node]} of the cluster has not answered for {limit:.0f} s; others do its "
                    "work, too."
                )
        return found

    def _there(self) -> bool:
        """Whether an actor has answered; what it prepares may take long where its cores have other work."""
        return any(member.asked != "versions" or member.answer is None for member in self._members)


def first_line(error: Exception, word: str = "") -> str:
    """The first line of what an error says, among those that have a word."""
    lines = [line.strip() for line in str(error).splitlines() if word in line and line.strip()]
    return lines[0].rstrip(".") if lines else type(error).__name__
