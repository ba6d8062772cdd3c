"""From files to files: downsampling them, and comparing methods of downsampling on them."""
