"""What methods see: estimated hands, parts and contacts. `PredictorNoise().scaled(0)` shows them
the truth."""

from r2h_batch.predictors.contacts import predict_contacts
from r2h_batch.predictors.files import load_predictor
from r2h_batch.predictors.given import Seen, read_seen
from r2h_batch.predictors.grid import ContactPredictor, PredictorError
from r2h_batch.predictors.hands import (
    ReceivingHand,
    TargetHand,
    predict_receiving,
    predict_target,
    retrieve_receiving,
)
from r2h_batch.predictors.noise import PredictorNoise
from r2h_batch.predictors.parts import SeenParts, predict_parts

__all__ = [
    "ContactPredictor",
    "PredictorError",
    "PredictorNoise",
    "ReceivingHand",
    "Seen",
    "SeenParts",
    "TargetHand",
    "load_predictor",
    "predict_contacts",
    "predict_parts",
    "predict_receiving",
    "predict_target",
    "read_seen",
    "retrieve_receiving",
]
