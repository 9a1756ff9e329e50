"""Where the robot is from a place of which only bearings are known, told by the way toward it.

`localizer.py` ties tracks to a trail, `guesses.py` follows several trails while two views can be explained in
several ways, `trail.py` is one of them: postures (`keyframes.py`) and landmarks (`rays.py`) that wheels and
pixels make most likely (`bundle.py`).
"""
