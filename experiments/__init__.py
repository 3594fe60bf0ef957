"""The paper's sequences as pure step plans."""
