"""A model as one self-contained web page: the splats, and a program that draws their kernels in any browser."""
