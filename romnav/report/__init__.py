"""Tables, figures and listings from recorded episodes."""
