"""How a process of a service ends once it has closed all that it had open."""

import logging
import os
import sys
from typing import NoReturn


def leave(code: int) -> NoReturn:
    """End this process at once, with nothing left but what is still to be written to its standard streams.

    An interpreter that lets go of a thousand modules takes a quarter of a second for it, and more than two where others
    want its cores: half of the time within which a service stops.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
