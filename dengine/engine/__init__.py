"""`DataEngine`, and the objects that it decides, learns and retrains with.

This file holds no code; import `DataEngine` from `dengine`.
"""
