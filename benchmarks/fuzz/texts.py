"""Good input that is text."""

CAMERA_TOML = """\
width = 64
height = 48
fx = 60.0
fy = 60.0
cx = 31.5
cy = 23.5
distortion = [-0.1, 0.01, 0.0, 0.0, 0.0]
height_m = 0.3
forward_m = 0.05
"""
ROBOT_TOML = """\
[network]
endpoints = ["tcp/192.168.1.10:7447"]

[robot]
driver = "arduino"

[robot.options]
port = "/dev/ttyUSB0"

[robot.geometry]
radius = 0.12
ranger_bearings_deg = [45, 0, -45]
"""

FORM = (
    b'--b\r\nContent-Disposition: form-data; name="image"; filename="a.png"\r\n'
    b"Content-Type: image/png\r\n\r\n%s"
    b'\r\n--b\r\nContent-Disposition: form-data; name="height_m"\r\n\r\n1.4\r\n--b--\r\n'
)
G2O = b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nEDGE_SE2 0 1 1 0 0.1 100 0 0 100 0 400\n"
TUM = b"1.0 0 0 0 0 0 0 1\n1.1 0.1 0 0 0 0 0 1\n"
KEY = b'name = "r0"\nrole = "robot"\nfleet = "demo"\nendpoints = ["tls/10.0.0.5:7447"]\npassword = "secret"\n'
PLAN_FORM = (
    b'--b\r\nContent-Disposition: form-data; name="image"; filename="a.png"\r\n'
    b"Content-Type: image/png\r\n\r\n%s"
    b'\r\n--b\r\nContent-Disposition: form-data; name="map"; filename="map.yaml"\r\n\r\n'
    b"image: a.png\nresolution: 0.05\norigin: [-1.0, 2.0, 0.1]\nnegate: 1\r\n--b--\r\n"
)
NAV2_MAP = (
    b"image: a.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.1]\nnegate: 0\noccupied_thresh: 0.65\n"
    b"free_thresh: 0.196\nmode: trinary\n"
)
UNMERGE = '{"unmerge": ["r0.1", "r1.1"], "because": "two like doors", "by": "anna", "check": true}'
RETIRE = '{"area": {"anchor": "r0.1.17", "corners": [[0, -1], [2, -1], [2, 1]]}, "because": "rebuilt"}'
PLACE = '{"name": "kitchen", "body": {"kind": "place", "node": "r0.1.17"}, "who": "anna"}'
WORLD_TOML = """\
name = "flat"
seed = 7
height = 2.4
start_rooms = ["hall"]

[[rooms]]
name = "hall"
low = [0.0, 0.0]
high = [3.0, 2.0]
floor = "tiles"
paint = 150

[[walls]]
start = [0.0, 2.05]
end = [3.0, 2.05]
thickness = 0.1
texture = "plaster"

[[furniture]]
name = "cupboard"
at = [2.4, 1.7]
length = 1.0
width = 0.45
height = 1.7
heading_deg = 0.0
texture = "cupboard"

[[posters]]
at = [1.0, 1.9]
width = 0.6
height = 0.4
bottom = 0.3
texture = "photograph"
"""
