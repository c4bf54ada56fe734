"""What ``active6d benchmark`` measures."""
