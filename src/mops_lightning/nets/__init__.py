"""Networks: plain torch modules in (B·N, C) layout."""
