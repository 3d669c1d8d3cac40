"""What `pans train` chooses for a user's own images, and what the sensor then achieves beside a camera.

`recipe.py` chooses how images may be varied, light, encoder and the size of the training, with its reasons. `own.py` trains and judges,
from arrays too (`train_own`). `results.py` holds `SensorResults`, its table and its pictures.
"""
