"""The engine's whole decision as one checked file for the cell controller: TorchScript, or ONNX.
The family writes such files, reads and runs them in Python, writes the C++ sources that run them in
a cell, and imports the journals that these cells write.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
