"""The engine's whole decision as one checked file for the cell controller: TorchScript, or ONNX."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
