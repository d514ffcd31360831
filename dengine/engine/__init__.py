"""`DataEngine`, and the objects that decide, learn and retrain for it. This file holds no code;
import `DataEngine` from `dengine`.
"""
