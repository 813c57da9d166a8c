"""Streams a directory of frames to a running Foreframe and writes the frames it predicts.

    pip install websockets
    foreframe export --dataset moving-observer --episode 3 --out look
    python examples/stream.py --frames look --actions look/actions.json --out seen

The actions file is JSON, {"actions": [[linear, angular], ...], "states": [[...], ...]}, one entry a frame; a model that is
told nothing needs none. After the frame of number N, the prediction of the k-th frame to come is OUT/after-N-k.png.
A server that asks for a key is shown --key, or better STREAM_KEY, which other users of the machine do not see.
"""

import argparse
import base64
import json
import os
import pathlib
import urllib.error
import urllib.request

from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--server", default="http://127.0.0.1:8642", help="where Foreframe listens (default: %(default)s)")
parser.add_argument("--model", default="moving", help="a model's name (default: %(default)s)")
parser.add_argument("--frames", required=True, type=pathlib.Path, help="a directory of PNG or JPEG frames")
parser.add_argument("--actions", type=pathlib.Path, help="what the robot did and said of itself, as JSON")
parser.add_argument("--out", required=True, type=pathlib.Path, help="the directory to write into")
parser.add_argument("--key", default=os.environ.get("STREAM_KEY"), help="an API key (default: $STREAM_KEY)")
args = parser.parse_args()

trace = json.loads(args.actions.read_text()) if args.actions else {}
frames = sorted(path for path in args.frames.iterdir() if path.suffix in {".png", ".jpg", ".jpeg"})
args.out.mkdir(parents=True, exist_ok=True)


def frame_message(seq, period_s):
    image = frames[seq]
    message = {
        "type": "frame",
        "seq": seq,
        "timestamp_us": round(seq * period_s * 1e6),
        "image": base64.b64encode(image.read_bytes()).decode(),
        "format": "png" if image.suffix == ".png" else "jpeg",
    }
    for field, values in (("action", trace.get("actions")), ("state", trace.get("states"))):
        if values and seq < len(values):
            message[field] = values[seq]
    return json.dumps(message)


def keep(answer):
    if answer["type"] == "error":
        raise SystemExit(f"frame {answer['next_seq']}: {answer['detail']}")
    if answer["type"] == "prediction":
        for step, image in enumerate(answer["frames"], start=1):
            (args.out / f"after-{answer['seq']}-{step}.png").write_bytes(base64.b64decode(image))
        print(f"frame {answer['seq']}: {len(answer['frames'])} predicted in {answer['timing']['compute_us']} us")


authorization = {"Authorization": f"Bearer {args.key}"} if args.key else {}
body = json.dumps({"model": args.model, "format": "png"}).encode()
headers = {"Content-Type": "application/json", **authorization}
try:
    with urllib.request.urlopen(urllib.request.Request(f"{args.server}/v1/sessions", body, headers)) as answer:
        session = json.load(answer)
except urllib.error.HTTPError as refused:
    raise SystemExit(json.load(refused)["detail"]) from None
url = f"{args.server.replace('http', 'ws', 1)}{session['stream']}?token={session['token']}"

# A session outlives its socket: where the connection breaks, connect again and go on with the frame that is next.
seq = 0
while seq < len(frames):
    try:
        with connect(url, subprotocols=["foreframe.v1.json"], additional_headers=authorization, max_size=None) as socket:
            ready = json.loads(socket.recv())
            print(f"model {ready['model']} version {ready['version']}: {ready['spec']['context']} frames, then predictions")
            for seq in range(ready["next_seq"], len(frames)):
                socket.send(frame_message(seq, ready["spec"]["frame_period_s"]))
                keep(json.loads(socket.recv()))
            seq = len(frames)
            socket.send(json.dumps({"type": "close"}))
    except ConnectionClosedError:
        print("the connection broke; going on")
