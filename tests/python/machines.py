"""Machines of one network, as Linux network namespaces of this machine, and links between them that delay, lose and cut.

Each machine has one TUN device. What it sends is read by a process of ours, which passes it on as the link says. Needs root
and /dev/net/tun.
"""

import fcntl
import heapq
import multiprocessing
import os
import random
import select
import struct
import subprocess
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection

NETWORK = "198.18.0"
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
#: The machine of the test itself: it stays outside the namespaces.
HERE = "client"


@dataclass(frozen=True)
class Link:
    """What happens to a packet between two machines, in each direction."""

    delay_s: float = 0.0
    #: The share of packets that are lost.
    loss: float = 0.0
    bytes_per_s: float = float("inf")
    is_cut: bool = False


PERFECT = Link()


class Network:
    """Machines by name; the first one is the test itself. A context manager."""

    def __init__(self, names: list[str], prefix: str) -> None:
        self.names = [HERE, *names]
        self._prefix = prefix
        self._orders, relay_end = multiprocessing.Pipe()
        devices = [self._device(number) for number in range(len(self.names))]
        self._relay = multiprocessing.get_context("fork").Process(target=_relay, args=(devices, relay_end), daemon=True)
        self._relay.start()
        relay_end.close()
        # With the relay, the devices end.
        for device in devices:
            os.close(device)

    def __enter__(self) -> "Network":
        return self

    def __exit__(self, *_: object) -> None:
        self._orders.send(None)
        self._relay.join()
        for name in self.names[1:]:
            subprocess.run(["ip", "netns", "delete", self._namespace(name)], check=False)

    def address(self, name: str) -> str:
        return f"{NETWORK}.{1 + self.names.index(name)}"

    def inside(self, name: str, command: list[str]) -> list[str]:
        """The command, run on a machine."""
        return command if name == HERE else ["ip", "netns", "exec", self._namespace(name), *command]

    def set(self, one: str, other: str, link: Link) -> None:
        """What happens to packets between two machines from now on."""
        self._orders.send((self.names.index(one), self.names.index(other), link))

    def set_all(self, link: Link) -> None:
        for one in self.names:
            for other in self.names[: self.names.index(one)]:
                self.set(one, other, link)

    def _namespace(self, name: str) -> str:
        return f"{self._prefix}-{name}"

    def _device(self, number: int) -> int:
        name, device_name = self.names[number], f"{self._prefix}{number}"
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", device_name.encode(), IFF_TUN | IFF_NO_PI))
        if name != HERE:
            subprocess.run(["ip", "netns", "delete", self._namespace(name)], check=False, stderr=subprocess.DEVNULL)
            subprocess.run(["ip", "netns", "add", self._namespace(name)], check=True)
            subprocess.run(["ip", "link", "set", device_name, "netns", self._namespace(name)], check=True)
            subprocess.run(self.inside(name, ["ip", "link", "set", "lo", "up"]), check=True)
        ip = self.inside(name, ["ip"])
        subprocess.run([*ip, "address", "add", f"{self.address(name)}/24", "dev", device_name], check=True)
        subprocess.run([*ip, "link", "set", device_name, "up"], check=True)
        return device


def _relay(devices: list[int], orders: Connection) -> None:
    """Passes packets on until it is told to end."""
    links: dict[tuple[int, int], Link] = {}
    # Of links with a rate: when the last packet has left.
    free_s: dict[tuple[int, int], float] = {}
    waiting: list[tuple[float, int, int, bytes]] = []
    count, dice = 0, random.Random(1)
    while True:
        until_next_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        ready, _, _ = select.select([orders, *devices], [], [], until_next_s)
        now_s = time.monotonic()
        for source, device in enumerate(devices):
            # A few at a time from each, so that none waits for another.
            for _ in range(32 if device in ready else 0):
                try:
                    packet = os.read(device, 65536)
                except BlockingIOError:
                    break
                target = packet[19] - 1 if packet[0] >> 4 == 4 else len(devices)
                if target >= len(devices):
                    continue
                link = links.get((source, target), PERFECT)
                if link.is_cut or dice.random() < link.loss:
                    continue
                leaves_s = max(now_s, free_s.get((source, target), 0.0)) + len(packet) / link.bytes_per_s
                free_s[source, target] = leaves_s
                count += 1
                heapq.heappush(waiting, (leaves_s + link.delay_s, count, target, packet))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, target, packet = heapq.heappop(waiting)
            try:
                os.write(devices[target], packet)
            except OSError:
                # A full queue loses packets, as a switch does.
                pass
        if orders in ready:
            order = orders.recv()
            if order is None:
                return
            one, other, link = order
            links[one, other] = links[other, one] = link
