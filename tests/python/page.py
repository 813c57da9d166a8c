"""The page at / in Chromium: what its views show and do, what they weigh, and whether everybody can use them.

    page.py PROGRAM MODELS SCRATCH [SCREENSHOTS]
"""

import base64
import io
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
import zipfile
import json

from axe_playwright_python.sync_playwright import Axe
from PIL import Image
from playwright.sync_api import expect, sync_playwright

VIEWS = ["play", "dream", "what-if", "data", "data?set=room", "train"]
MAX_BYTES = 300_000
# The page alone takes a fraction of it; CI machines are busy.
MAX_FIRST_PICTURE_S = 30.0
# Of one core, at 5 frames/s. The browsers of CI draw in software, so this is above what people see.
MAX_CPU_SHARE = 0.5
MAX_HIDDEN_CPU_SHARE = 0.02


class Server:
    """The program, which can be stopped and started again on its port."""

    def __init__(self, program, models, scratch):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}"
        self.command = [program, "serve", "--bind", f"127.0.0.1:{self.port}", "--models-dir", models]
        self.command += ["--data-dir", str(scratch / "data"), "--set", 'admin_bind="off"']
        self.log = open(scratch / "server.log", "ab")

    def start(self):
        self.process = subprocess.Popen(self.command, stdout=self.log, stderr=self.log)
        wait_until(lambda: self.get("/readyz") is not None, "the server is ready")

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(timeout=30)

    def get(self, path):
        try:
            with urllib.request.urlopen(self.address + path, timeout=5) as answer:
                return json.load(answer)
        except OSError:
            return None

    def post(self, path, body):
        request = urllib.request.Request(self.address + path, json.dumps(body).encode(), {"Content-Type": "application/json"})
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)


def wait_until(holds, what, timeout_s=60):
    ends = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < ends, f"never: {what}"
        time.sleep(0.1)


# How many different gray levels each canvas in sight has: one or two mean an empty picture.
LEVELS = """selector => [...document.querySelectorAll(selector)].filter(canvas => canvas.offsetParent).map(canvas => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return new Set(data).size;
})"""


def pictures(page, selector=".picture canvas"):
    return page.evaluate(LEVELS, selector)


def are_full(page, count, selector=".picture canvas:not(.difference canvas)"):
    found = pictures(page, selector)
    return len(found) >= count and min(found) > 4


def wait_for_pictures(page, count, selector=".picture:not(.difference) canvas"):
    wait_until(lambda: are_full(page, count, selector), f"{count} pictures in {selector}")


def wait_for_verdict(page):
    wait_until(lambda: page.locator(".verdict .line").inner_text().startswith(("Error", "Nothing moves")), "a verdict")


class Browser:
    """Chromium; every page's errors are collected."""

    def __init__(self, playwright, executable, address):
        self.address = address
        self.errors = []
        self.executable = executable
        self.chromium = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])

    def open(self, hash="", width=1280, dark=False, height=900):
        context = self.chromium.new_context(viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light")
        page = context.new_page()
        page.on("pageerror", lambda error: self.errors.append(f"{hash}: {error}"))
        page.on("console", lambda message: self.refused(hash, message))
        page.goto(f"{self.address}/#{hash}")
        return page

    def refused(self, hash, message):
        if "Content Security Policy" in message.text:
            self.errors.append(f"{hash}: {message.text}")


def opens_on_the_best_drivable_model(browser, server):
    started = time.monotonic()
    page = browser.open()
    wait_for_pictures(page, 1)
    first_s = time.monotonic() - started
    models = server.get("/v1/models")["models"]
    drivable = [model for model in models if model["spec"]["conditioning"].endswith("action") and model["lineage"]["scenario"]]
    best = max(drivable, key=lambda model: model["metrics"]["test"]["skill"])
    assert page.get_by_label("Model").input_value() == best["name"]
    wait_for_verdict(page)
    wait_for_pictures(page, 7)
    assert page.locator("img").count() == 0, "pictures are canvases, which cannot break"
    expect(page.locator(".driver")).to_have_text("It drives itself until you touch a key")
    assert first_s < MAX_FIRST_PICTURE_S, first_s
    print(f"first picture after {first_s:.2f} s")
    page.context.close()


def keys_and_touch_drive(browser, server):
    page = browser.open("play")
    wait_for_verdict(page)
    page.keyboard.down("w")
    wait_until(lambda: "linear 0.35 m/s" in page.locator(".play").inner_text(), "the key drives")
    page.keyboard.up("w")
    page.get_by_role("button", name="let it drive").click()
    expect(page.locator(".driver")).to_have_text("It drives itself until you touch a key")
    left = page.get_by_role("button", name="drive left").bounding_box()
    page.mouse.move(left["x"] + 5, left["y"] + 5)
    page.mouse.down()
    wait_until(lambda: "angular 0.90 rad/s" in page.locator(".play").inner_text(), "the button drives")
    page.mouse.up()
    page.context.close()


def pictures_stay_in_sight_of_who_drives_on_a_phone(browser, server):
    for width, height in [(390, 560), (844, 390)]:
        for view, pictures in [("play", ".play > .three"), ("dream", ".dream .two")]:
            page = browser.open(view, width=width, height=height)
            wait_for_pictures(page, 1)
            page.get_by_role("button", name="drive back").evaluate("button => button.scrollIntoView({ block: 'end' })")
            header, shown = page.locator("header").bounding_box(), page.locator(pictures).bounding_box()
            ahead, back = (page.get_by_role("button", name=f"drive {way}").bounding_box() for way in ["ahead", "back"])
            facts = view, width, header, shown, ahead, back
            assert shown["y"] >= max(0, header["y"] + header["height"] - 1) and shown["y"] + shown["height"] <= height, facts
            assert ahead["y"] >= shown["y"] + shown["height"] or ahead["x"] >= shown["x"] + shown["width"], facts
            assert back["y"] + back["height"] <= height + 1, facts
            page.context.close()


def a_plot_leaves_out_a_pause(browser, server):
    page = browser.open("play")
    wait_for_verdict(page)
    # The labels of the time axis, which are drawn on a canvas.
    page.evaluate("""() => {
      const draw = CanvasRenderingContext2D.prototype.fillText;
      CanvasRenderingContext2D.prototype.fillText = function (text, ...place) { window.drawn.push(text); return draw.call(this, text, ...place); };
    }""")

    def oldest_s():
        page.evaluate("window.drawn = []")
        labels = lambda: [float(label) for label in page.evaluate("window.drawn") if re.fullmatch(r"-[0-9.]+", label)]
        wait_until(labels, "a drawn plot")
        return min(labels())

    hide = "value => { Object.defineProperty(document, 'hidden', { value, configurable: true }); document.dispatchEvent(new Event('visibilitychange')); }"
    before_s, started = oldest_s(), time.monotonic()
    page.evaluate(hide, True)
    time.sleep(12)
    page.evaluate(hide, False)
    time.sleep(2)
    shown_s = time.monotonic() - started - 12
    after_s = oldest_s()
    assert after_s > before_s - shown_s - 5, (before_s, shown_s, after_s)
    page.context.close()


def a_model_of_rooms_is_driven_in_varied_rooms(browser, server):
    page = browser.open("play?model=rooms")
    posted = []
    page.on("request", lambda request: posted.append(request.post_data) if request.method == "POST" else None)
    page.reload()
    wait_for_verdict(page)
    assert page.get_by_label("Source").locator("option").all_inner_texts()[:2] == ["simulator, varied rooms", "simulator, one room"]
    assert any('"rooms":"varied"' in body for body in posted if body), "the environment is in a room of its own"
    assert any('"camera":{"height_m"' in body for body in posted if body), "its camera is sent"
    wait_for_pictures(page, 7)
    errors = []
    page.on("response", lambda response: errors.append(response.url) if response.status >= 400 else None)
    page.goto(f"{server.address}/#what-if?model=rooms")
    wait_until(lambda: page.locator(".plan.best").count() == 1, "a best plan in a varied room", 120)
    page.goto(f"{server.address}/#dream?model=rooms")
    expect(page.get_by_role("button", name="Cut the camera")).to_be_enabled(timeout=60_000)
    page.keyboard.press("Space")
    wait_until(lambda: float(page.locator(".imagined").inner_text().split()[0]) >= 0.4, "a dream in a varied room")
    assert not errors, errors
    page.context.close()


def survives_restarts(browser, server):
    page = browser.open("play")
    wait_for_verdict(page)
    for _ in range(2):
        server.stop()
        expect(page.locator(".state")).to_have_text("reconnecting", timeout=10_000)
        assert are_full(page, 7, ".picture:not(.difference) canvas"), "the last pictures stay"
        server.start()
        expect(page.locator(".state")).to_have_text("connected", timeout=15_000)
        wait_until(lambda: page.locator(".play .dim").count() == 0, "new pictures")
    page.context.close()


def a_dream_goes_on_and_is_saved(browser, server):
    page = browser.open("dream")
    expect(page.get_by_role("button", name="Cut the camera")).to_be_enabled(timeout=20_000)
    page.keyboard.press("Space")
    imagined_s = lambda: float(page.locator(".imagined").inner_text().split()[0])
    wait_until(lambda: imagined_s() >= 1.4, "a dream of 1.4 s")
    wait_for_pictures(page, 2)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save GIF").click()
    saved = pathlib.Path(download.value.path()).read_bytes()
    # The control block of each frame.
    assert saved.startswith(b"GIF89a") and saved.count(b"\x21\xf9\x04") >= 7, len(saved)
    page.keyboard.press("Space")
    expect(page.locator(".imagined")).to_have_text("0.0 s imagined")
    page.keyboard.press("Space")
    wait_until(lambda: imagined_s() >= 0.4, "another dream")
    page.context.close()


def a_plan_is_chosen_and_taken(browser, server):
    page = browser.open("what-if")
    wait_until(lambda: page.locator(".plan.best").count() == 1, "a best plan")
    wait_for_pictures(page, 9, ".plan canvas")
    present = page.evaluate("document.querySelector('.overview canvas').toDataURL()")
    page.get_by_role("button", name="hard left").click()
    wait_until(lambda: page.evaluate("document.querySelector('.overview canvas').toDataURL()") != present, "the robot moves")
    wait_until(lambda: page.locator(".plan:enabled").count() == 9, "plans from the new place")
    page.context.close()


def an_episode_is_played(browser, server):
    page = browser.open("data")
    wait_for_pictures(page, 1, ".card canvas")
    page.locator("a.card", has_text="room").click()
    # Playwright waits until the best model has predicted something.
    page.get_by_role("button", name="jump to the worst").click(timeout=60_000)
    address = lambda: page.evaluate("location.hash")
    wait_until(lambda: "frame=" in address() and "frame=0" not in address(), "the address holds the frame")
    wait_for_pictures(page, 2)
    page.get_by_role("button", name="next", exact=True).click()
    wait_until(lambda: "episode=1" in address(), "the address holds the episode")
    page.get_by_text("Inspection: what").click()
    wait_until(lambda: page.get_by_text("Contact sheet").count() == 1, "the inspection", 120)
    page.context.close()


def walk():
    """An archive of 30 images at 5 frames/s."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("walk/log.csv", "timestamp,file,speed\n" + "".join(f"{index / 5},{index}.png,1\n" for index in range(30)))
        for index in range(30):
            image = io.BytesIO()
            Image.effect_noise((64, 48), 20 + index).save(image, "PNG")
            file.writestr(f"walk/{index}.png", image.getvalue())
    return archive.getvalue()


def a_dropped_file_is_imported(browser, server):
    page = browser.open("data")
    drop = page.locator("form.drop")
    drop.wait_for()
    transfer = """([name, encoded]) => {
      const transfer = new DataTransfer();
      transfer.items.add(new File([Uint8Array.from(atob(encoded), letter => letter.charCodeAt(0))], name));
      return transfer;
    }"""
    dropped = lambda name, content: page.evaluate_handle(transfer, [name, base64.b64encode(content).decode()])
    drop.dispatch_event("drop", {"dataTransfer": dropped("notes.txt", b"no recording")})
    expect(drop.locator(".wrong")).to_contain_text("Drop one file: an archive")
    drop.dispatch_event("drop", {"dataTransfer": dropped("My Walk.zip", walk())})
    job = lambda name: page.locator(".making", has_text=f"import {name}")
    expect(job("my-walk")).to_contain_text("not imported: speed", timeout=60_000)
    job("my-walk").get_by_role("link", name="open it").click(timeout=60_000)
    assert "set=my-walk" in page.evaluate("location.hash")
    wait_for_pictures(page, 1)
    # What it lacks is not asked of it.
    page.goto(f"{server.address}/#train")
    page.locator("form", has_text="New training").get_by_label("Data set").select_option("my-walk")
    expect(page.locator("form", has_text="New training")).to_contain_text("no actions, so model.conditioning=none is set. ")
    expect(page.locator(".estimate")).to_contain_text("Memory: at least", timeout=20_000)
    # The second import of that name is refused, and its upload can be imported under another name.
    page.goto(f"{server.address}/#data")
    page.locator("form.drop input[type=file]").set_input_files({"name": "my walk.zip", "mimeType": "application/zip", "buffer": walk()})
    expect(page.get_by_text("data set \"my-walk\" exists")).to_be_visible(timeout=20_000)
    assert page.locator("form.drop input[name=source]").input_value().startswith("upload:")
    page.locator("form.drop input[name=name]").fill("another-walk")
    page.get_by_label("Keep every Nth frame").fill("2")
    page.get_by_text("Camera and damage").click()
    page.get_by_label("Field of view").fill("90")
    page.get_by_label("Looks down by").fill("12")
    page.get_by_role("button", name="Import", exact=True).click()
    job("another-walk").get_by_role("link", name="open it").click(timeout=60_000)
    assert "set=another-walk" in page.evaluate("location.hash")
    found = next(one for one in server.get("/v1/datasets")["datasets"] if one["name"] == "another-walk")
    assert (found["frame_period_s"], found["frames"]) == (0.4, 15), found
    assert found["camera"] and abs(found["camera"]["tilt_down_rad"] - 0.2094) < 1e-3, found
    page.on("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Delete this data set").click()
    expect(page.locator("a.card", has_text="my-walk")).to_have_count(1)
    expect(page.locator("a.card", has_text="another-walk")).to_have_count(0)
    page.context.close()


def a_training_is_watched(browser, server):
    page = browser.open("train")
    form = page.locator("form", has_text="New training")
    expect(page.locator("form", has_text="New adaptation").get_by_label("Start from")).to_have_value("rooms")
    form.get_by_label("Preset").locator("option[value=paper]").wait_for(state="attached")
    # The settings of a model take the place of a preset's.
    form.get_by_label("Start from").select_option("static")
    expect(form.get_by_label("Preset")).to_have_count(0)
    form.get_by_label("Start from").select_option("new weights")
    form.get_by_label("Data set").select_option("room")
    form.get_by_label("Preset").select_option("static")
    form.get_by_label("Name of the model").fill("tiny")
    form.get_by_label("Steps").fill("40")
    form.get_by_label("Other settings").fill("pretrain.steps=20\nrun.validate_every_steps=10\nmodel.hidden=16\nmodel.features=16")
    expect(page.locator(".estimate")).to_have_text(re.compile(r"Memory: at least [0-9.]+ [MG]iB of "))
    page.get_by_role("button", name="Train", exact=True).click()
    state = page.locator(".watched h2 span")
    page.locator(".watched").get_by_role("button", name="Cancel").click()
    expect(state).to_have_text("cancelled", timeout=60_000)
    page.locator(".watched").get_by_role("button", name="Resume").click()
    expect(page.locator(".jobs tr.chosen")).to_contain_text("(2 attempts, with pauses)", timeout=60_000)
    wait_until(lambda: page.locator(".watched .plot canvas").count() == 1, "losses", 120)
    width = lambda: page.evaluate("document.querySelector('.sample img')?.naturalWidth")
    wait_until(lambda: width() == 5 * 64 + 4 * 2, "a sample prediction", 120)
    wait_until(lambda: page.locator("article h3", has_text="tiny").count() == 1, "the new model's card", 240)
    expect(state).to_have_text("succeeded", timeout=60_000)
    page.context.close()


def a_new_version_is_activated_and_evaluated(browser, server):
    """The trainings and the evaluation are somebody else's; the open page shows what they change."""
    page = browser.open("train")
    card = page.locator("article", has_text="small")
    settings = {"pretrain": {"steps": 2}, "sequence": {"steps": 2}, "model": {"hidden": 16, "features": 16}}
    training = {"kind": "train", "name": "small", "dataset": "room", "preset": "static", "settings": settings}
    server.post("/v1/jobs", training)
    expect(card).to_contain_text("skill not measured", timeout=240_000)
    server.post("/v1/jobs", training)
    expect(card.locator(".versions")).to_contain_text("version 2", timeout=240_000)
    page.get_by_role("button", name="Activate version 2").click(timeout=60_000)
    expect(page.locator(".watched")).to_contain_text("Published as version 2 of small; it is active")
    evaluation = server.post("/v1/jobs", {"kind": "evaluate", "model": "small", "dataset": "room", "windows": 10})["id"]
    expect(card).not_to_contain_text("skill not measured", timeout=240_000)
    page.locator(".jobs a", has_text=evaluation).click()
    expect(page.locator(".watched h2").first).to_contain_text("evaluate small version 2 on room")
    expect(page.locator(".report h2 code").first).to_have_text("small")
    with page.expect_download() as download:
        page.get_by_role("button", name="download the report").click()
    assert pathlib.Path(download.value.path()).read_text().startswith("# Model `small`")
    page.context.close()


def everybody_can_use_it(browser, server, screenshots):
    total = 0
    for view in VIEWS:
        for width, dark in [(1280, False), (1280, True), (390, False), (390, True)]:
            page = browser.open(view, width, dark)
            page.wait_for_timeout(2500)
            name = f"{view.replace('?set=', '-')} at {width} px, {'dark' if dark else 'light'}"
            if screenshots:
                page.screenshot(path=screenshots / f"{name}.png", full_page=True)
            found = Axe().run(page)
            total += found.violations_count
            if found.violations_count:
                print(name, found.generate_report())
            overhang_px = page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert overhang_px <= 0, f"{name}: {overhang_px} px too wide"
            page.context.close()
    print(f"axe: {total} violations in {4 * len(VIEWS)} pages")
    assert total == 0


def it_is_small(browser, server):
    page = browser.open("play")
    session = page.context.new_cdp_session(page)
    session.send("Network.enable")
    received = {"": 0}
    session.on("Network.loadingFinished", lambda event: received.update({event["requestId"]: event["encodedDataLength"]}))
    paths = {}
    session.on("Network.requestWillBeSent", lambda event: paths.update({event["requestId"]: event["request"]["url"]}))
    session.send("Network.setCacheDisabled", {"cacheDisabled": True})
    page.reload()
    wait_for_verdict(page)
    own = [name for name, url in paths.items() if "/v1/" not in url and not url.startswith("data:")]
    bytes_ = sum(received.get(name, 0) for name in own)
    print(f"{bytes_} bytes in {len(own)} files")
    assert bytes_ < MAX_BYTES
    page.context.close()


def cpu_share(browser, seconds):
    session = browser.chromium.new_browser_cdp_session()
    total = lambda: sum(process["cpuTime"] for process in session.send("SystemInfo.getProcessInfo")["processInfo"])
    before = total()
    time.sleep(seconds)
    return (total() - before) / seconds


def cpu_s(process):
    """The CPU time of a process and of all below it."""
    found = {}
    for path in pathlib.Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        found[int(path.parent.name)] = (int(fields[1]), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"))
    family, total = [process], 0.0
    for one in family:
        total += found.get(one, (0, 0.0))[1]
        family += [child for child, (parent, _) in found.items() if parent == one]
    return total


def it_takes_little_of_the_cpu(browser, server):
    """In a browser that nobody watches: Playwright reads every message, which costs as much again as some of them."""
    with tempfile.TemporaryDirectory() as profile:
        command = [browser.executable, "--headless", "--no-sandbox", f"--user-data-dir={profile}", "--window-size=1280,900"]
        command += ["--remote-debugging-port=0", f"{server.address}/#play"]
        alone = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            time.sleep(12)
            shares = []
            for _ in range(3):
                before = cpu_s(alone.pid)
                time.sleep(10)
                shares.append((cpu_s(alone.pid) - before) / 10)
        finally:
            alone.terminate()
            alone.wait(timeout=30)
    print(f"CPU of a browser with Play: {100 * min(shares):.1f} % of a core")
    assert 0.01 < min(shares) < MAX_CPU_SHARE, shares


def it_rests_when_hidden(browser, server):
    page = browser.open("play")
    wait_for_verdict(page)
    time.sleep(2)
    visible = cpu_share(browser, 10)
    page.evaluate("Object.defineProperty(document, 'hidden', { value: true }); document.dispatchEvent(new Event('visibilitychange'))")
    time.sleep(2)
    hidden = cpu_share(browser, 10)
    print(f"CPU of all processes of the browser: {100 * visible:.1f} % of a core, hidden {100 * hidden:.1f} %")
    assert visible < MAX_CPU_SHARE and hidden < MAX_HIDDEN_CPU_SHARE
    page.context.close()


def main():
    program, models, scratch = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
    screenshots = pathlib.Path(sys.argv[4]) if len(sys.argv) > 4 else None
    executable = next(filter(None, map(shutil.which, ["chromium", "chromium-browser", "google-chrome"])))
    scratch.mkdir(parents=True, exist_ok=True)
    server = Server(program, models, scratch)
    server.start()
    collect = {"kind": "collect", "name": "room", "scenario": "moving-observer", "trials": 40, "seed": 11}
    job = server.post("/v1/jobs", collect)["id"]
    wait_until(lambda: (server.get(f"/v1/jobs/{job}") or {}).get("state") == "succeeded", "a data set", 240)
    tests = [opens_on_the_best_drivable_model, pictures_stay_in_sight_of_who_drives_on_a_phone, a_plot_leaves_out_a_pause, a_model_of_rooms_is_driven_in_varied_rooms, keys_and_touch_drive, survives_restarts, a_dream_goes_on_and_is_saved, a_plan_is_chosen_and_taken]
    tests += [an_episode_is_played, a_dropped_file_is_imported, it_is_small, it_takes_little_of_the_cpu, it_rests_when_hidden, a_training_is_watched, a_new_version_is_activated_and_evaluated]
    only = os.environ.get("PAGE_TEST")
    try:
        with sync_playwright() as playwright:
            browser = Browser(playwright, executable, server.address)
            for test in [test for test in tests if only in (None, test.__name__)]:
                started = time.monotonic()
                test(browser, server)
                print(f"{test.__name__}: {time.monotonic() - started:.1f} s", flush=True)
            if only in (None, "everybody_can_use_it"):
                everybody_can_use_it(browser, server, screenshots)
            assert not browser.errors, browser.errors
            browser.chromium.close()
    finally:
        server.stop()


main()
