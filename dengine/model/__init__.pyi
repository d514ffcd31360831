from .base import EngineModel as EngineModel
from .base import Model as Model
from .base import Prediction as Prediction
from .base import RivalAdapter as RivalAdapter
from .neighbours import ModelPrediction as ModelPrediction
