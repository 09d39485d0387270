"""How many sweeps per second `beambox serve` answers, and how long each takes: clients on this machine.

python benchmarks/serve_load.py --model pointpillars-kitti --clients 4 --requests 100
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="pointpillars-sim")
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--requests", type=int, default=100, help="of all clients together")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--scan", type=Path, help="a .bin to send; a simulated sweep if none")
    options = parser.parse_args()
    body = options.scan.read_bytes() if options.scan else simulated()
    words = [sys.executable, "-m", "beambox", "serve", "--model", options.model, "--port", "0"]
    service = subprocess.Popen([*words, "--batch", str(options.batch)], stderr=subprocess.PIPE, text=True)
    try:
        url = address(service)
        post(url, body)  # compiles
        seconds, taken, statuses = load(url, body, options.clients, options.requests)
        with urllib.request.urlopen(f"{url}/health", timeout=10) as answer:
            health = json.load(answer)
    finally:
        service.terminate()
        service.wait(30)
    taken.sort()
    print(
        f"{options.model}, {len(body) / 1e6:.1f} MB per sweep, {options.clients} clients, {options.requests} requests: "
        f"{len(taken) / seconds:.2f} answers/s, median {taken[len(taken) // 2] * 1e3:.0f} ms, "
        f"p95 {taken[int(len(taken) * 0.95)] * 1e3:.0f} ms, statuses {dict(statuses)}, "
        f"{health['sweeps'] / health['batches']:.1f} sweeps per batch"
    )


def simulated() -> bytes:
    """Return a simulated sweep of the front view as float32 records."""
    from beambox.simulate import simulate_frame

    return simulate_frame(0, 0).points.numpy().tobytes()


def address(service: subprocess.Popen[str]) -> str:
    assert service.stderr is not None
    for line in service.stderr:
        if found := re.search(r"http://[^;]+", line):
            return found[0]
    raise SystemExit("the service did not start")


def post(url: str, body: bytes) -> int:
    request = urllib.request.Request(f"{url}/detect", data=body, method="POST")
    try:
        with urllib.request.urlopen(request, timeout=120) as answer:
            answer.read()
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def load(url: str, body: bytes, clients: int, requests: int) -> tuple[float, list[float], Counter[int]]:
    """Send from several threads, each the next as soon as it has its answer."""
    left, lock = iter(range(requests)), threading.Lock()
    taken: list[float] = []
    statuses: Counter[int] = Counter()

    def client() -> None:
        while True:
            with lock:
                if next(left, None) is None:
                    return
            start = time.perf_counter()
            status = post(url, body)
            with lock:
                taken.append(time.perf_counter() - start)
                statuses[status] += 1

    threads = [threading.Thread(target=client) for _ in range(clients)]
    start = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return time.perf_counter() - start, taken, statuses


if __name__ == "__main__":
    main()
