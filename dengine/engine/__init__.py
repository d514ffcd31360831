"""The engine. This file holds no code; import `DataEngine` from `dengine`."""
