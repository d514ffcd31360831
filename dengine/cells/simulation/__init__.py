"""A robot cell simulated in MuJoCo: gripper, wrist, fixture, force sensor, height check. cell.py
has the cell that an engine drives, conditions.py the settings and what is drawn from them, world.py
the physics of one insertion, generate.py many insertions as a data set. Nothing is exported here:
`SimulatedCell` is imported from `dengine.cells`.
"""
