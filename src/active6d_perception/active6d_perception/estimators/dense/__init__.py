"""The learned estimator: a network says per pixel where its object's centre is and which point of the object it sees;
poses follow from that. ``docs/estimator.md`` tells why it is made this way."""
