"""Operations: each folder holds a readable reference beside its fast versions."""
