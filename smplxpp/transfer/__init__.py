"""Transfer skin weights from the body to the parts that it wears."""

from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.rigid import rigid_weights, shoe_weights
from smplxpp.transfer.transfer import transfer_weights

__all__ = ["TransferConfig", "rigid_weights", "shoe_weights", "transfer_weights"]
