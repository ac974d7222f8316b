"""Offline tools: from a glTF character to textures and levels of detail that `runtime` draws."""
