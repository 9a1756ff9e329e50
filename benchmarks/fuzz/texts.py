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
