"""One file per handover method: a batch of trials in, grasp and handover poses out."""
