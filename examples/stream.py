"""Streams a directory of frames to a running Foreframe and writes the frames it predicts.

    pip install websockets
    foreframe export --dataset moving-observer --episode 3 --out look
    python examples/stream.py --frames look --actions look/actions.json --out seen

The actions file is JSON, {"actions": [[linear, angular], ...], "states": [[...], ...]}, with one entry for each frame. A model
that takes neither actions nor state needs no such file. The k-th frame predicted after frame N is OUT/after-N-k.png.
If the server asks for an API key, pass --key or, so that other users of the machine cannot see it, set STREAM_KEY.
"""

import argparse
import base64
import json
import os
import pathlib
import urllib.error
import urllib.request

try:
    from websockets.exceptions import ConnectionClosedError, WebSocketException
    from websockets.sync.client import connect
except ImportError:
    raise SystemExit("this example needs the package websockets: pip install websockets") from None

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--server", default="http://127.0.0.1:8642", help="where Foreframe listens (default: %(default)s)")
parser.add_argument("--model", default="moving", help="a model's name (default: %(default)s)")
parser.add_argument("--frames", required=True, type=pathlib.Path, help="a directory of PNG or JPEG frames")
parser.add_argument("--actions", type=pathlib.Path, help="the robot's actions and states, as JSON")
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


def save(answer):
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
except urllib.error.URLError as error:
    raise SystemExit(f"no server answers at {args.server} ({error.reason}); start one with: foreframe serve") from None
url = f"{args.server.replace('http', 'ws', 1)}{session['stream']}?token={session['token']}"

# A session outlives its connection: after a break, connect again and continue with the next frame.
seq = 0
while seq < len(frames):
    try:
        with connect(url, subprotocols=["foreframe.v1.json"], additional_headers=authorization, max_size=None) as socket:
            ready = json.loads(socket.recv())
            print(f"model {ready['model']} version {ready['version']}: {ready['spec']['context']} frames, then predictions")
            for seq in range(ready["next_seq"], len(frames)):
                socket.send(frame_message(seq, ready["spec"]["frame_period_s"]))
                save(json.loads(socket.recv()))
            seq = len(frames)
            socket.send(json.dumps({"type": "close"}))
    except ConnectionClosedError:
        print("the connection broke; connecting again")
    except (OSError, WebSocketException) as error:
        raise SystemExit(f"the stream at {args.server} ended: {error}") from None
