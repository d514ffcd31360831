from .base import BaselineAdapter as BaselineAdapter
from .base import EngineModel as EngineModel
from .base import Model as Model
from .base import Prediction as Prediction
from .neighbours import ModelPrediction as ModelPrediction
