"""Inputs of methods: estimated hands, parts and contacts. With `PredictorNoise().scaled(0)` they
see the truth."""

from r2h_batch.methods.predictors.contacts import Contacts, predict_contacts
from r2h_batch.methods.predictors.external_predictions import Observations, read_observations
from r2h_batch.methods.predictors.files import load_predictor
from r2h_batch.methods.predictors.grid import ContactPredictor
from r2h_batch.methods.predictors.hands import (
    ReceivingHand,
    TargetHand,
    predict_receiving,
    predict_target,
    retrieve_receiving,
)
from r2h_batch.methods.predictors.parts import SeenParts, predict_parts
from r2h_batch.trials.noise import PredictorNoise

__all__ = [
    "ContactPredictor",
    "Contacts",
    "Observations",
    "PredictorNoise",
    "ReceivingHand",
    "SeenParts",
    "TargetHand",
    "load_predictor",
    "predict_contacts",
    "predict_parts",
    "predict_receiving",
    "predict_target",
    "read_observations",
    "retrieve_receiving",
]
