class Operators(Module):
  __parameters__ = []
  __buffers__ = []
  training : bool
  def pack_convolution(self: __torch__.Operators, w: Tensor, w_scale: Tensor, x_scale: float, x_zero: int, stride: List[int], padding: List[int], x_shape: List[int]) -> Tensor:
    return ops.onednn.qconv_prepack(w, w_scale, x_scale, x_zero, stride, padding, [1, 1], 1, x_shape)
  def convolve(self: __torch__.Operators, x: Tensor, x_scale: float, x_zero: int, w: Tensor, w_scale: Tensor, w_zero: Tensor, bias: Optional[Tensor], y_scale: float, y_kind: int, after: str, stride: List[int], padding: List[int]) -> Tensor:
    return ops.onednn.qconv2d_pointwise(x, x_scale, x_zero, w, w_scale, w_zero, bias, stride, padding, [1, 1], 1, y_scale, 0, y_kind, after, annotate(List[Optional[number]], []), "")
  def pack_linear(self: __torch__.Operators, w: Tensor, x_shape: List[int]) -> Tensor:
    return ops.onednn.qlinear_prepack(w, x_shape)
  def multiply(self: __torch__.Operators, x: Tensor, x_scale: float, x_zero: int, w: Tensor, w_scale: Tensor, w_zero: Tensor, bias: Optional[Tensor], y_scale: float, y_kind: int, after: str) -> Tensor:
    return ops.onednn.qlinear_pointwise(x, x_scale, x_zero, w, w_scale, w_zero, bias, y_scale, 0, y_kind, after, annotate(List[Optional[number]], []), "")
