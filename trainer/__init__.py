"""The torch trainer: learns patterns and back ends through the noise of single-photon detection."""
