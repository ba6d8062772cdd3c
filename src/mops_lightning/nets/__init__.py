"""Task nets and their layers: plain torch modules."""
