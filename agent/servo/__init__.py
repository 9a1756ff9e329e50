"""Visual servoing: parks the robot at a pose while enough landmarks stay in the field of view.

Read `supervisor.py` first: it decides, tick by tick, which of the paper's five laws (`laws.py`) or which leg
of a plan (`plan.py`) drives. `image_drive.py` is the exploration drive, `blind.py` the drive without a view,
`proximity.py` the last safety layer under all of them. Values in, values out: no camera, no wire, no clock.
"""
