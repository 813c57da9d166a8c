"""Streams a directory of frames to a running Foreframe and writes the frames it predicts.

    pip install websockets
    foreframe export --dataset moving-observer --episode 3 --out look
    python examples/stream.py --frames look --actions look/actions.json --out seen

The actions file is JSON, {"actions": [[linear, angular], ...], "states": [[...], ...]}, one entry a frame; a model that is
told nothing needs none. After the frame of number N, the prediction of the k-th frame to come is OUT/after-N-k.png.
"""

import argparse
import base64
import json
import pathlib

from websockets.sync.client import connect

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--server", default="ws://127.0.0.1:8642", help="where Foreframe listens (default: %(default)s)")
parser.add_argument("--model", default="moving", help="a model's name (default: %(default)s)")
parser.add_argument("--frames", required=True, type=pathlib.Path, help="a directory of PNG or JPEG frames")
parser.add_argument("--actions", type=pathlib.Path, help="what the robot did and said of itself, as JSON")
parser.add_argument("--out", required=True, type=pathlib.Path, help="the directory to write into")
args = parser.parse_args()

trace = json.loads(args.actions.read_text()) if args.actions else {}
frames = sorted(path for path in args.frames.iterdir() if path.suffix in {".png", ".jpg", ".jpeg"})
args.out.mkdir(parents=True, exist_ok=True)

url = f"{args.server}/v1/models/{args.model}/stream"
with connect(url, subprotocols=["foreframe.v1.json"], max_size=None) as socket:
    ready = json.loads(socket.recv())
    print(f"model {ready['model']} version {ready['version']}: {ready['spec']['context']} frames, then predictions")
    for seq, path in enumerate(frames):
        message = {
            "type": "frame",
            "seq": seq,
            "timestamp_us": round(seq * ready["spec"]["frame_period_s"] * 1e6),
            "image": base64.b64encode(path.read_bytes()).decode(),
            "format": "jpeg" if path.suffix in {".jpg", ".jpeg"} else "png",
        }
        for field, values in (("action", trace.get("actions")), ("state", trace.get("states"))):
            if values and seq < len(values):
                message[field] = values[seq]
        socket.send(json.dumps(message))
        answer = json.loads(socket.recv())
        if answer["type"] == "error":
            raise SystemExit(f"frame {seq}: {answer['detail']}")
        for step, image in enumerate(answer.get("frames", []), start=1):
            (args.out / f"after-{seq}-{step}.png").write_bytes(base64.b64decode(image))
        if answer["type"] == "prediction":
            print(f"frame {seq}: {len(answer['frames'])} predicted in {answer['timing']['compute_us']} us")
    socket.send(json.dumps({"type": "close"}))
