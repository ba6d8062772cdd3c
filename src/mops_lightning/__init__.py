"""Task-oriented point cloud downsampling: MOPS-Net and the methods that it is compared with.

``__init__.pyi`` lists the public names. They are imported on first use, so that ``import
mops_lightning`` and ``--help`` do not wait for torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
