// nvidia_builtins.cl: OpenCL's built-in functions for NVIDIA GPUs, by libdevice, as NVIDIA's own driver has them.
//
// Only those that clsplat's kernels call. A missing one ends in "unresolved extern function" of ptxas.

#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#define OVERLOADED __attribute__((overloadable))

#define BY_LIBDEVICE(name) \
    float __nv_##name##f(float); \
    double __nv_##name(double); \
    float OVERLOADED name(float x) { return __nv_##name##f(x); } \
    double OVERLOADED name(double x) { return __nv_##name(x); }
BY_LIBDEVICE(exp)
BY_LIBDEVICE(log)
BY_LIBDEVICE(log1p)
BY_LIBDEVICE(expm1)
BY_LIBDEVICE(tanh)
BY_LIBDEVICE(cosh)
BY_LIBDEVICE(cbrt)
BY_LIBDEVICE(sin)
BY_LIBDEVICE(cos)
BY_LIBDEVICE(erfc)

// The instructions of the GPU, with denormal numbers as zero: -cl-denorms-are-zero.
float __nvvm_ex2_approx_ftz_f(float);
float __nvvm_rcp_approx_ftz_f(float);
float OVERLOADED native_exp2(float x) { return __nvvm_ex2_approx_ftz_f(x); }
float OVERLOADED native_recip(float x) { return __nvvm_rcp_approx_ftz_f(x); }

#define BY_CLANG(name, function) \
    float OVERLOADED name(float x) { return __builtin_elementwise_##function(x); } \
    double OVERLOADED name(double x) { return __builtin_elementwise_##function(x); }
BY_CLANG(sqrt, sqrt)
BY_CLANG(fabs, abs)
BY_CLANG(floor, floor)
BY_CLANG(ceil, ceil)
BY_CLANG(rint, rint)

float __nv_fminf(float, float);
float __nv_fmaxf(float, float);
double __nv_fmin(double, double);
double __nv_fmax(double, double);
float __nv_powf(float, float);
double __nv_pow(double, double);
int __nv_clz(int);

#define BY_REALS(real, suffix) \
    real OVERLOADED min(real a, real b) { return __nv_fmin##suffix(a, b); } \
    real OVERLOADED max(real a, real b) { return __nv_fmax##suffix(a, b); } \
    real OVERLOADED pow(real a, real b) { return __nv_pow##suffix(a, b); } \
    real OVERLOADED fma(real a, real b, real c) { return __builtin_elementwise_fma(a, b, c); } \
    real OVERLOADED mad(real a, real b, real c) { return __builtin_elementwise_fma(a, b, c); } \
    real OVERLOADED sign(real x) { return x > 0 ? (real)1 : x < 0 ? (real)(-1) : (real)0; } \
    uchar OVERLOADED convert_uchar_sat(real x) { return (uchar)(int)min(max(x, (real)0), (real)255); }
BY_REALS(float, f)
BY_REALS(double, )

int OVERLOADED min(int a, int b) { return a < b ? a : b; }
int OVERLOADED max(int a, int b) { return a > b ? a : b; }
uint OVERLOADED min(uint a, uint b) { return a < b ? a : b; }
uint OVERLOADED max(uint a, uint b) { return a > b ? a : b; }
uint OVERLOADED clz(uint a) { return __nv_clz((int)a); }
uint OVERLOADED mul_hi(uint a, uint b) { return (uint)(((ulong)a * b) >> 32); }
float OVERLOADED vload_half(size_t i, const __global half *p) { return __builtin_load_halff(p + i); }

#define BY_AXIS(name, register) \
    size_t OVERLOADED name(uint axis) { \
        return axis == 0   ? __nvvm_read_ptx_sreg_##register##_x() \
               : axis == 1 ? __nvvm_read_ptx_sreg_##register##_y() \
                           : __nvvm_read_ptx_sreg_##register##_z(); \
    }
BY_AXIS(get_local_id, tid)
BY_AXIS(get_local_size, ntid)
BY_AXIS(get_group_id, ctaid)
BY_AXIS(get_num_groups, nctaid)
size_t OVERLOADED get_global_id(uint axis) { return get_group_id(axis) * get_local_size(axis) + get_local_id(axis); }
size_t OVERLOADED get_global_size(uint axis) { return get_num_groups(axis) * get_local_size(axis); }
void OVERLOADED __attribute__((convergent)) barrier(cl_mem_fence_flags flags) { __syncthreads(); }
