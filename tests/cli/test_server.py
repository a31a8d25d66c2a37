"""The server of a living scene: this machine only, the page, its details and the exports only, ended by ctrl-C."""

import http.client
import os
import signal
import subprocess
import sys
import threading

import pytest
from factories import living_scene

from more2_jax.cli.server import TYPES, address_of, scene_server, served_files
from more2_jax.config import SceneConfig
from more2_jax.export import SUFFIXES
from more2_jax.storage.scene_folder import save_scene


@pytest.fixture
def served(tmp_path):
    """A folder `room` with a page, an export beside it, and what nobody may have."""
    room = tmp_path / "room"
    room.mkdir()
    (room / "report.html").write_text("<p>räum</p>", encoding="utf-8")
    (room / "scene.json").write_text("secret")
    (tmp_path / "room.glb").write_bytes(b"glTF")
    (tmp_path / "other.glb").write_text("secret")
    (tmp_path / "key").write_text("secret")
    (tmp_path / "room.ply").symlink_to(tmp_path / "key")
    (tmp_path / "room.js").write_text("secret")
    (room / "report_details").mkdir()
    (room / "report_details" / "0.js").write_text("more2Detail()")
    (room / "report_details" / "notes.txt").write_text("secret")
    (room / "report_details" / "1.js").symlink_to(tmp_path / "key")
    server = scene_server(room)
    threading.Thread(target=lambda: server.serve_forever(poll_interval=0.02), daemon=True).start()
    yield room, server
    server.shutdown()
    server.server_close()


def ask(server, path="/", method="GET", host=None):
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=5)
    connection.request(method, path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_loopback_alone(served):
    _, server = served
    assert server.server_address[0] == "127.0.0.1"
    assert address_of(server) == f"http://127.0.0.1:{server.server_address[1]}/"


def test_the_page_and_the_exports(served):
    room, server = served
    assert ask(server) == ask(server, "/report.html?x#y") == (200, "<p>räum</p>")
    assert ask(server, method="HEAD") == (200, "")
    assert ask(server, "/room.glb") == (200, "glTF")
    (room / "report.html").write_text("later", encoding="utf-8")
    assert ask(server) == (200, "later")
    (room / "report.html").unlink()
    assert ask(server)[0] == 404


def test_the_details_are_scripts_of_the_page_and_of_no_other_site(served):
    connection = http.client.HTTPConnection(*served[1].server_address[:2], timeout=5)
    connection.request("GET", "/report_details/0.js")
    answer = connection.getresponse()
    assert (answer.status, answer.read()) == (200, b"more2Detail()")
    assert answer.headers["Content-Type"].startswith("text/javascript")
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_a_folder_of_details_that_leads_elsewhere_is_left_out(served):
    room, server = served
    (room / "report_details").rename(room.parent / "elsewhere")
    (room / "report_details").symlink_to(room.parent / "elsewhere")
    assert ask(server, "/report_details/0.js")[0] == 404


@pytest.mark.parametrize(
    "path",
    [
        "/scene.json",
        "/../key",
        "/%2e%2e/key",
        "/..%2fkey",
        "/../other.glb",
        "/other.glb",
        "/room/../../key",
        "/key",
    ]
    + [
        "/room.ply",
        "/report.html/",
        "/report.html/..",
        "/report.html%00",
        "/..",
        "/./report.html",
        "/%2froom.glb",
    ]
    + ["/\\..\\key", "/room.js", "/0.js", "/report_details", "/report_details/"]
    + [f"/report_details/{name}" for name in ("notes.txt", "1.js", "2.js", "../scene.json", "%2e%2e/key")],
)
def test_nothing_else(served, path):
    status, body = ask(served[1], path)
    assert status == 404
    assert "secret" not in body


def test_nothing_is_taken(served):
    assert all(ask(served[1], method=verb)[0] == 501 for verb in ("POST", "PUT", "DELETE", "OPTIONS"))


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:80", " "])
def test_other_names_for_this_machine_are_refused(served, host):
    assert ask(served[1], host=host)[0] == 403


def test_every_format_of_export_has_a_type(tmp_path):
    room = tmp_path / "room"
    for suffix in SUFFIXES.values():
        room.with_suffix(suffix).touch()
    assert set(served_files(room)) == {f"room{suffix}" for suffix in SUFFIXES.values()}
    assert set(SUFFIXES.values()) <= set(TYPES)


def test_a_port_that_cannot_be_had_is_told(served):
    room, server = served
    with pytest.raises(ValueError, match=r"port \d+ of 127\.0\.0\.1"):
        scene_server(room, server.server_address[1])
    with pytest.raises(ValueError, match="port 70000"):
        scene_server(room, 70000)


def show(*arguments) -> subprocess.Popen:
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    # Whoever runs tests in the background lets them ignore interrupts; the program under test should hear them.
    heard = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    start = "from more2_jax.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", heard + start, "show", *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def test_show_serves_until_interrupted(tmp_path):
    save_scene(living_scene(), tmp_path / "room", SceneConfig())
    with show(tmp_path / "room", "--serve") as process:
        assert process.stdout is not None and process.stderr is not None
        address = process.stdout.readline().split()[0]
        connection = http.client.HTTPConnection(address.removeprefix("http://").rstrip("/"), timeout=5)
        connection.request("GET", "/")
        assert "Living scene" in connection.getresponse().read().decode()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 0
        assert process.stdout.read() + process.stderr.read() == ""


def test_a_port_needs_serve(tmp_path):
    save_scene(living_scene(), tmp_path / "room", SceneConfig())
    with show(tmp_path / "room", "--port", 8000) as process:
        _, told = process.communicate(timeout=60)
    assert process.returncode == 2
    assert len(told.splitlines()) == 1 and "--serve" in told
