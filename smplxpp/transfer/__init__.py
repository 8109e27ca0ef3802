"""Transfer skin weights from the body to the parts that it wears."""

from smplxpp.transfer.config import TransferConfig
from smplxpp.transfer.transfer import transfer_weights

__all__ = ["TransferConfig", "transfer_weights"]
