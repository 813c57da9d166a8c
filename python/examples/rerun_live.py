"""Shows in Rerun's viewer what a model predicts for a robot, live.

    pip install './python[rerun]'
    python python/examples/rerun_live.py --model moving-flow              # opens the viewer
    python python/examples/rerun_live.py --model moving-flow --save drive.rrd

The robot is a simulated one of the server. For your own, call ``RerunLog.step`` with each of its frames and the session's answer.
"""

import argparse
import time

import rerun

import foreframe
from foreframe.rerun_log import RerunLog


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--server", help="the URL of a running server; default: start one with the program `foreframe`")
    parser.add_argument("--key")
    parser.add_argument("--model", default="moving-flow")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--save", metavar="FILE", help="write a recording instead of opening the viewer; then at full speed")
    arguments = parser.parse_args()
    recording = rerun.RecordingStream("foreframe")
    if arguments.save:
        recording.save(arguments.save)
    else:
        recording.spawn()
    server = None if arguments.server else foreframe.serve()
    with foreframe.Client(arguments.server or server.url, key=arguments.key) as client:
        model = client.model(arguments.model)
        scenario = model.lineage.get("scenario") or "moving-observer"
        log = RerunLog(recording, model.spec.period_s)
        with client.environment(scenario, seed=1, world={"max_duration_s": 3600}) as robot, client.session(arguments.model) as session:
            seen = robot.observation
            for _ in range(arguments.frames):
                started = time.monotonic()
                log.step(seen.frame, session.step(seen.frame, action=seen.policy_action, state=seen.state))
                step = robot.step(seen.policy_action)
                if step.terminated or step.truncated:
                    break
                seen = step.observation
                if not arguments.save:
                    time.sleep(max(0.0, model.spec.period_s - (time.monotonic() - started)))
    recording.flush()


if __name__ == "__main__":
    main()
